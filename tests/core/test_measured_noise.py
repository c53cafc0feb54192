from pathlib import Path

import numpy as np
import pytest

from srtomo_core.noise import read_noise


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"cov": np.eye(4)}, "expected an .npz file with numbers in 'covariance'"),
        ({"covariance": np.eye(5)}, r"covariance: expected shape \(4, 4\), got \(5, 5\)"),
        ({"covariance": np.full((4, 4), np.nan)}, "covariance: expected finite numbers, symmetric"),
        ({"covariance": np.triu(np.ones((4, 4)))}, "covariance: expected finite numbers, symmetric"),
        ({"covariance": -np.eye(4)}, "covariance: expected positive definite; are there frames enough\\?"),
    ],
)
def test_a_file_that_is_no_covariance(content: dict[str, np.ndarray], problem: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "noise.npz", **content)
    with pytest.raises(ValueError, match=problem):
        read_noise(str(tmp_path / "noise.npz"), 4)
    with pytest.raises(ValueError, match="No such file"):
        read_noise(str(tmp_path / "none.npz"), 4)
