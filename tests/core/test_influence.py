from pathlib import Path

import numpy as np
import pytest

from srtomo_core.influence import read_influence
from srtomo_core.system import load_system

BUMP = np.pad(np.ones((1, 1)), 2)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    each = np.stack([BUMP, 2 * BUMP, 3 * BUMP])
    np.savez(tmp_path / "three.npz", step=0.2, functions=each)
    functions = read_influence(str(tmp_path / "three.npz"), 3)
    assert functions.reach == pytest.approx(0.4)
    assert np.array_equal(functions.of(2), 3 * BUMP)
    np.savez(tmp_path / "one.npz", step=0.2, functions=BUMP)
    assert np.array_equal(read_influence(str(tmp_path / "one.npz"), 3).of(2), BUMP)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"functions": BUMP}, "expected an .npz file with 'step' and 'functions'"),
        ({"step": 0.1, "functions": BUMP[:4]}, "functions: expected one or 3, each square and odd, got shape"),
        ({"step": 0.1, "functions": BUMP[:4, :4]}, "functions: expected one or 3, each square and odd, got shape"),
        ({"step": 0.1, "functions": np.stack([BUMP, BUMP])}, "functions: expected one or 3, each square"),
        ({"step": 0.0, "functions": BUMP}, "expected a step above 0 and finite functions"),
        ({"step": 0.1, "functions": np.nan * BUMP}, "expected a step above 0 and finite functions"),
        ({"step": 0.1, "functions": np.ones((5, 5))}, "expected zero at the edges of their windows"),
    ],
)
def test_a_file_that_holds_none(content: dict[str, np.ndarray], problem: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "bad.npz", **content)
    with pytest.raises(ValueError, match=problem):
        read_influence(str(tmp_path / "bad.npz"), 3)


def test_a_text_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.npz").write_text("nothing")
    with pytest.raises(ValueError, match=r"expected an \.npz file"):
        read_influence(str(tmp_path / "bad.npz"), 3)


def test_files_are_looked_for_beside_the_instrument_s(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "srtomo_core/systems/mini.yaml").read_text()
    text = text.replace("coupling: 0.3,", "coupling: 0.3, influence: mirrors/dm.npz,")
    (tmp_path / "own.yaml").write_text(text)
    system = load_system(tmp_path / "own.yaml")
    assert system.mirrors[0].influence == str(tmp_path / "mirrors" / "dm.npz")
    assert system.with_changes({"loop.gain": 0.4}).mirrors == system.mirrors
