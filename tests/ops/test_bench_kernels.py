"""``srtomo bench kernels``: its table, and that no figure comes of a kernel that does not do what it states."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import load_system
from srtomo_ops.bench import kernels
from srtomo_ops.cli import main
from srtomo_rtc.loop import Matrices
from srtomo_sim.mirror import interaction_matrix


@pytest.fixture(scope="module")
def small() -> SimpleNamespace:
    """``mini`` and a reconstructor of it."""
    system = load_system("mini")
    layout = Layout(system)
    G = interaction_matrix(system, layout)
    R = np.linalg.solve(G.T @ G + 3e-3 * np.linalg.norm(G, 2) ** 2 * np.eye(layout.n_commands), G.T)
    made = Reconstructor.from_matrices(R, G, fingerprint=layout.fingerprint, gain=0.5, command_limit=layout.stroke)
    return SimpleNamespace(system=system, reconstructor=made)


def test_the_table_is_of_what_was_checked(
    small: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    small.reconstructor.save(tmp_path / "r.npz")
    arguments = ["bench", "kernels", "mini", "--reconstructor", str(tmp_path / "r.npz"), "--frames", "3"]
    assert main([*arguments, "--threads", "2", "--json", str(tmp_path / "k.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = json.loads((tmp_path / "k.json").read_text())["kernels"]
    found = [(row["kernel"], row["threads"]) for row in rows]
    kinds = ("float32", "int16", *(f"tlr {tolerance:g}" for tolerance in kernels.TOLERANCES))
    assert found == [(kernel, threads) for kernel in kinds for threads in (1, 2)]
    assert all(len(row["seconds"]) == 3 and row["median"] > 0 for row in rows)
    for row in rows:
        assert any(re.match(rf"{row['kernel']} +{row['threads']} ", line) for line in lines)
        # two dozen vectors; float32 has its own rounding
        assert row["drawn"] == pytest.approx(row["error"], rel=0.25, abs=1e-5)


def test_without_a_reconstructor_there_is_nothing_to_compress(capsys: pytest.CaptureFixture) -> None:
    assert main(["bench", "kernels", "mini"]) != 0
    assert "--reconstructor: expected a file of 'srtomo reconstruct'" in capsys.readouterr().err


def test_a_kernel_that_states_another_matrix_gives_no_figure(
    small: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = Matrices.R.fget
    assert stated is not None
    monkeypatch.setattr(Matrices, "R", property(lambda self: 1.001 * stated(self)))
    with pytest.raises(ValueError, match="float32: a product is not that of the matrix that is stated"):
        kernels.measure(small.system, small.reconstructor, [1], 2)


def test_a_reconstructor_of_another_instrument_is_refused(small: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="expected a static one of mini"):
        kernels.measure(load_system("mini", {"zenith_angle": "5 deg"}), small.reconstructor, [1], 2)
