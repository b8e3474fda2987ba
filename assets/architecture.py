"""Draws assets/architecture.png, the picture in the README: python assets/architecture.py

Above the network with its shapes, below its two trainings. The background is drawn, too, so that
the picture reads the same on a white and on a black page. Letters are those of model.py.
"""

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

DATA, NETWORK, FROZEN, WEIGHTS, LOSS = "#f6e3b4", "#bcd8f2", "#d5d5d5", "#c8e6c0", "#f4c7c3"
LEGEND = {
    "data": DATA,
    "network, trained": NETWORK,
    "network, frozen": FROZEN,
    "weights": WEIGHTS,
    "loss": LOSS,
}
PAGE, PANEL, INK, LINE = "#ffffff", "#f3f4f6", "#1a1a1a", "#4a4a4a"

figure = Figure(figsize=(11, 9.2), facecolor=PAGE)
axes = figure.add_axes((0, 0, 1, 1))
axes.set(xlim=(0, 110), ylim=(-46, 46))
axes.set_axis_off()


def label(x: float, y: float, text: str, fontsize: float = 8, weight: str = "normal") -> None:
    """Text whose middle is at (x, y)."""
    axes.text(x, y, text, fontsize=fontsize, weight=weight, color=INK, ha="center", va="center")


def box(
    x: float, y: float, width: float, title: str, text: str, color: str, height: float = 8
) -> None:
    """A box whose lower left corner is at (x, y)."""
    style = "round,pad=0,rounding_size=1"
    axes.add_patch(
        FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor=color, edgecolor=LINE)
    )
    lines = text.count("\n") + 1
    center = x + width / 2
    middle = y + height / 2
    label(center, middle + 1.1 * lines, title, fontsize=10, weight="bold")
    label(center, middle - 1.1, text)


def panel(x: float, y: float, width: float, height: float, title: str) -> None:
    """A field with a title, on which boxes lie."""
    style = "round,pad=0,rounding_size=1"
    axes.add_patch(
        FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor=PANEL, edgecolor="#d0d0d0")
    )
    axes.text(
        x + 1.5, y + height - 2.2, title, fontsize=10.5, weight="bold", color=INK, va="center"
    )


def arrow(
    *corners: tuple[float, float],
    text: str = "",
    at: tuple[float, float] = (0, 0),
    dashed: bool = False,
) -> None:
    """Straight lines through the corners, the last with a head; its text has its middle at `at`."""
    linestyle = "--" if dashed else "-"
    axes.plot(
        [x for x, _ in corners[:-1]],
        [y for _, y in corners[:-1]],
        color=LINE,
        linewidth=1.4,
        linestyle=linestyle,
        solid_capstyle="round",
    )
    axes.add_patch(
        FancyArrowPatch(
            corners[-2],
            corners[-1],
            arrowstyle="-|>",
            mutation_scale=12,
            shrinkA=0,
            color=LINE,
            linewidth=1.4,
            linestyle=linestyle,
        )
    )
    label(at[0], at[1], text)


# The network
panel(0.5, 1, 109, 44.5, "The network")
box(2, 31, 19, "Instruction", "one sentence", DATA)
box(2, 18, 19, "Demonstration", "one complete episode", DATA)
box(2, 5, 19, "Observation", "now and just before", DATA)

box(29, 31, 16, "CLIP", "text tower", FROZEN)
box(29, 5, 16, "PointNet + MLP", "a frame to a feature,\nthe same weights\nfor both", NETWORK, 21)
box(53, 18, 13.5, "VMT", "Transformer over\nframes and actions", NETWORK)
box(53, 5, 13.5, "$h_k$", "MLP of the features\nand of timestep k", NETWORK)
box(75, 18, 13, "U2T", "$h_k$ attends to\nframes and text", NETWORK)
box(93, 5, 15, "U-Net", "first level:\nFiLM by U2T\n(TCFM);\nothers: by $h_k$", NETWORK, 21)
box(93, 33, 15, "Actions", "(H, A) = (16, A),\nTa executed", DATA)

arrow((21, 35), (29, 35))
arrow((21, 22), (29, 22), text="(T, N, P)\n(T, S)", at=(24.7, 24.5))
arrow((21, 9), (29, 9), text="(To, N, P)\n(To, S)", at=(24.8, 11.5))
arrow((11.5, 26), (11.5, 28.5), (59.75, 28.5), (59.75, 26), text="actions (T, A)", at=(49, 29.7))
arrow((45, 35), (81.5, 35), (81.5, 26), text="(512)", at=(62, 36.3))
arrow((45, 22), (53, 22), text="(T, feature)", at=(49, 25))
arrow((45, 9), (53, 9), text="(To, feature)", at=(49, 12))
arrow((66.5, 22), (75, 22), text="(T, D)", at=(70.7, 23.4))
arrow((66.5, 9), (93, 9), text="(C)", at=(85, 10.4))
arrow((79, 9), (79, 18))
arrow((88, 22), (93, 22), text="(C)", at=(90.5, 23.4))
arrow((97, 26), (97, 33), text=r"$\hat A_0$", at=(95.2, 29.5))
arrow((104, 33), (104, 26), text="next $A_k$", at=(107, 29.5))
arrow((100.5, 1.8), (100.5, 5), text="starts from noise; k falls to 0", at=(88.5, 2.8))

letters = (
    "T frames of the demonstration, To = 2 of the observation; N points of P numbers, states of S, "
    "actions of A;\nH actions are planned, Ta of them executed; "
    "C numbers condition the U-Net; a token has D"
)
axes.text(20, 43.0, letters, fontsize=8, color=INK, va="center")

# Meta-training
panel(0.5, -37, 65, 36.5, "Meta-training (Algorithm 1)")
axes.text(2, -5.6, "for each task i, in every outer step", fontsize=8, color=INK)
box(2, -17, 13, "Batch", "windows, one\ndemonstration", DATA)
box(20, -12.5, 13, "Support", "some windows", DATA, 6)
box(20, -21.5, 13, "Query", "the others", DATA, 6)
box(38, -13, 12, "Loss", r"at $\theta$", LOSS, 7)
box(38, -22, 12, "Loss", r"at $\theta'_i$", LOSS, 7)
box(53.5, -13, 10.5, r"$\theta'_i$", "task's own", WEIGHTS, 7)
box(20, -35, 13, r"$\theta$", "meta-trained", WEIGHTS)
box(2, -35, 13, r"EMA of $\theta$", "what is kept", WEIGHTS)
arrow((15, -12), (17.5, -12), (17.5, -9.5), (20, -9.5))
arrow((15, -14.5), (17.5, -14.5), (17.5, -18.5), (20, -18.5))
arrow((33, -9.5), (38, -9.5))
arrow((33, -18.5), (38, -18.5))
arrow((50, -9.5), (53.5, -9.5))
axes.text(
    53, -4.6, r"inner step: $\theta - \alpha\nabla\mathcal{L}$", fontsize=8, color=INK, ha="center"
)
arrow((58.75, -13), (58.75, -18.5), (50, -18.5))
arrow((44, -22), (44, -31), (33, -31))
axes.text(
    45,
    -26.8,
    "outer step: AdamW on the mean\nover tasks, differentiated\nthrough the inner step",
    fontsize=8,
    color=INK,
    va="center",
)
arrow((26.5, -27), (26.5, -24), (35.5, -24), (35.5, -11.5), (38, -11.5), dashed=True)
arrow((20, -31), (15, -31))

# Adaptation
panel(67, -37, 42.5, 36.5, "Adaptation to a novel task (Algorithm 2)")
box(68.5, -17, 14, "Demonstrations", "ten; windows and\none as reference", DATA)
box(87, -16.5, 8.5, "Loss", r"at $\theta$", LOSS, 7)
box(99, -17, 9, r"$\theta$", "adapted", WEIGHTS)
box(68.5, -35, 14, "Meta-trained", "EMA, copied", WEIGHTS)
box(87, -35, 21, "Rollouts", "EMA of the adapted weights,\nnew goals", DATA)
arrow((82.5, -13), (87, -13))
arrow((95.5, -13), (99, -13))
arrow(
    (103.5, -9), (103.5, -6.5), (91.25, -6.5), (91.25, -9.5), text="200 steps of AdamW", at=(97, -5)
)
arrow((75.5, -27), (75.5, -22), (101, -22), (101, -17), text="start", at=(80, -20.8))
arrow((105.5, -17), (105.5, -27), text="EMA", at=(102.8, -25))
arrow((15, -33), (17, -33), (17, -36.2), (66.2, -36.2), (66.2, -31), (68.5, -31), dashed=True)

# Legend
axes.text(2, -42, "Colors:", fontsize=9, weight="bold", color=INK, va="center")
for i, (name, color) in enumerate(LEGEND.items()):
    x = 10 + 16.5 * i
    axes.add_patch(FancyBboxPatch((x, -43), 3, 2, boxstyle="square,pad=0", fc=color, ec=LINE))
    axes.text(x + 4, -42, name, fontsize=9, color=INK, va="center")
axes.plot([93, 96.5], [-42, -42], "--", color=LINE, linewidth=1.4)
axes.text(97.2, -42, "copied weights", fontsize=9, color=INK, va="center")

figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
