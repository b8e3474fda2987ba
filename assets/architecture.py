"""Draws assets/architecture.png, the picture in the README: python assets/architecture.py"""

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

DATA, NETWORK, FROZEN = (
    "#f3e3c3",
    "#c9dcf2",
    "#dddddd",
)  # light fills with dark text: legible on white and on black
LINE = "#8a8a8a"

figure = Figure(figsize=(11, 4.6))
axes = figure.add_axes((0, 0, 1, 1))
axes.set(xlim=(0, 110), ylim=(0, 46))
axes.set_axis_off()


def box(
    x: float, y: float, width: float, title: str, text: str, color: str, height: float = 8
) -> None:
    """A box whose lower left corner is at (x, y)."""
    style = "round,pad=0,rounding_size=1"
    axes.add_patch(
        FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor=color, edgecolor=LINE)
    )
    lines = text.count("\n") + 1
    middle = y + height / 2
    axes.text(
        x + width / 2,
        middle + 1.1 * lines,
        title,
        ha="center",
        va="center",
        fontsize=10,
        weight="bold",
        color="#222222",
    )
    axes.text(
        x + width / 2, middle - 1.1, text, ha="center", va="center", fontsize=8, color="#222222"
    )


def arrow(*corners: tuple[float, float], label: str = "", at: tuple[float, float] = (0, 0)) -> None:
    """Straight lines through the corners, the last with a head."""
    axes.plot(*zip(*corners[:-1]), color=LINE, linewidth=1.4, solid_capstyle="round")
    axes.add_patch(
        FancyArrowPatch(
            *corners[-2:], arrowstyle="-|>", mutation_scale=12, color=LINE, linewidth=1.4, shrinkA=0
        )
    )
    axes.text(*at, label, fontsize=8, color=LINE, ha="center", va="center")


box(1, 35, 19, "Instruction", "one sentence", DATA)
box(1, 21, 19, "Demonstration", "T clouds, states, actions:\none complete episode", DATA)
box(1, 7, 19, "Observation", "2 clouds and states:\nnow and just before", DATA)

box(26, 35, 17, "CLIP text tower", "frozen", FROZEN)
box(26, 7, 17, "PointNet + MLP", "a frame to a feature,\nthe same for both", NETWORK, height=22)
box(49, 21, 15, "VMT", "Transformer over T\nframes and actions", NETWORK)
box(49, 7, 15, "$h_k$", "MLP of the feature\nand of step k", NETWORK)
box(70, 21, 15, "U2T", "$h_k$ attends to\nframes and text", NETWORK)
box(91, 7, 18, "U-Net", "first level: FiLM by U2T\n(TCFM); others: by $h_k$", NETWORK, height=22)
box(91, 35, 18, "Actions", "16 predicted,\n8 executed", DATA)

arrow((20, 39), (26, 39))
arrow((20, 25), (26, 25))
arrow((20, 11), (26, 11))
arrow((43, 39), (77.5, 39), (77.5, 29), label="(512)", at=(60, 40.3))
arrow((43, 25), (49, 25))
arrow((43, 11), (49, 11))
arrow((64, 25), (70, 25))
arrow((64, 11), (91, 11), label="$h_k$", at=(81, 12.3))
arrow((74, 11), (74, 21))
arrow((85, 25), (91, 25))
arrow((96, 29), (96, 35), label="$A_0$", at=(93.7, 32))
arrow((105, 35), (105, 29), label="$A_{k-10}$", at=(101.5, 32))
arrow((100, 3), (100, 7), label="starts from noise, $k$ = 90, 80, ... 0", at=(86, 3.6))

figure.savefig(Path(__file__).with_suffix(".png"), dpi=110, transparent=True)
