"""A hexagonal mirror of six petals, from influence functions in a file, all the way to a reconstructor."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System, load_system
from srtomo_ops.cli import main
from srtomo_srtc.fitting import Fit

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "m4_like.py"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("m4")
    example().main(out)
    return out


def example() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE)))


@pytest.fixture(scope="module")
def petals(folder: Path) -> System:
    return load_system(folder / "m4_like.yaml")


def test_the_fit_is_the_dense_one(petals: System, folder: Path) -> None:
    layout, fit = Layout(petals), Fit(petals, Layout(petals))
    mirror, grid = layout.mirrors[0], fit.grid
    with np.load(folder / "m4_like.npz") as file:
        step, functions = float(file["step"]), np.pad(file["functions"].astype(float), ((0, 0), (4, 4), (4, 4)))
    middle = (functions.shape[1] - 1) / 2
    N = np.stack(
        [
            map_coordinates(one, [middle + (grid.y - y) / step, middle + (grid.x - x) / step], order=3)
            for one, (x, y) in zip(functions, mirror.actuators, strict=True)
        ],
        axis=1,
    )
    centred = N - grid.weight @ N
    rng = np.random.default_rng(0)
    wavefronts = rng.standard_normal((len(grid.x), 3))
    # least squares with the ridge as further equations
    root = np.sqrt(grid.weight)[:, None]
    rows = np.vstack([root * centred, np.sqrt(fit.ridge) * np.eye(mirror.n_actuators)])
    right = np.vstack([root * (wavefronts - grid.weight @ wavefronts), np.zeros((mirror.n_actuators, 3))])
    expected = np.linalg.lstsq(rows, right, rcond=None)[0]
    found = fit.solve(sum(view.projection @ wavefronts for view in fit.views))
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_petals_move_on_their_own(petals: System) -> None:
    """One petal's piston is a shape of this mirror, and not of one without gaps."""

    def left(system: System) -> float:
        fit = Fit(system, Layout(system), kappa=1e-6)
        shape = (example().petal_of(fit.grid.x, fit.grid.y) == 2).astype(float)
        made = fit.views[0].modes @ fit.solve(fit.views[0].projection @ shape[:, None])[:, 0]
        rest = shape - made
        return float(fit.grid.weight @ (rest - fit.grid.weight @ rest) ** 2)

    whole = petals.with_changes({"mirrors.0.influence": None})
    assert Layout(whole).mirrors[0].n_actuators == Layout(petals).mirrors[0].n_actuators
    assert left(petals) < 0.3 * left(whole)


def test_from_the_command_line(petals: System, folder: Path) -> None:
    output = folder / "m4.npz"
    assert main(["reconstruct", str(folder / "m4_like.yaml"), "-o", str(output)]) == 0
    assert Reconstructor.load(output).n_commands == Layout(petals).n_commands
