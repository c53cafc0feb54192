import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from srtomo_core.system import load_system
from srtomo_ops.bench import reconstruct
from srtomo_ops.bench.reconstruct import residual_of
from srtomo_ops.cli import main
from srtomo_srtc.reconstructors import implicit


def test_the_residual_tells_right_from_wrong() -> None:
    mini = load_system("mini")
    right, _ = implicit(mini)
    assert residual_of(mini, right) < 1e-4
    swapped = right.R.copy()
    swapped[:, :, :40] = right.R[:, :, 39::-1]
    assert residual_of(mini, replace(right, R=swapped)) > reconstruct.TOLERANCE
    assert residual_of(mini, replace(right, R=1.2 * right.R)) > reconstruct.TOLERANCE


def test_numbers_and_their_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "bench.json"
    assert main(["bench", "reconstruct", "mini", "--threads", "1", "--json", str(output)]) == 0
    assert "of a matrix product's" in capsys.readouterr().out
    numbers = json.loads(output.read_text())
    assert numbers["seconds"] >= sum(numbers["stage_seconds"].values()) * 0.99
    assert 0 < numbers["fraction_of_gemm"]
    assert numbers["peak_bytes"] > 2**26
    assert numbers["residual"] < reconstruct.TOLERANCE


def test_no_number_without_the_check(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def spoilt(*arguments: object, **keywords: object) -> object:
        reconstructor, G = implicit(*arguments, **keywords)  # type: ignore[arg-type]
        return replace(reconstructor, R=np.zeros_like(reconstructor.R)), G

    monkeypatch.setattr(reconstruct, "implicit", spoilt)
    assert main(["bench", "reconstruct", "mini"]) == 2
    streams = capsys.readouterr()
    assert "the reconstructor is wrong" in streams.err
    assert "GFLOP" not in streams.out
