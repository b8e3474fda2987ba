"""What several test files share: real demonstrations of four tasks of ML10, collected once a session."""

import os

import pytest

os.environ["OMP_NUM_THREADS"] = "1"  # before torch; on matrices this small, threads only wait for each other

import data

BASE, NOVEL = ["reach", "drawer-close", "window-open"], ["door-close"]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """A folder with two expert demonstrations of each task in BASE and NOVEL."""
    folder = tmp_path_factory.mktemp("demonstrations")
    data.collect(BASE + NOVEL, folder, episodes=2)
    return folder
