"""Multi-object correction: towards one direction, in open loop."""

import numpy as np
import pytest

from srtomo_core.system import System, load_system
from srtomo_srtc.reconstructors import implicit
from srtomo_srtc.reconstructors.moao import moao


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.mark.parametrize("target", [0, 1])
def test_it_is_the_implicit_one_for_an_instrument_with_one_target(mini: System, target: int) -> None:
    reconstructor, G = moao(mini, target=target)
    alone = mini.with_changes({"science.targets": [mini.science.targets[target].model_dump()]})
    R = implicit(alone)[0].R
    np.testing.assert_allclose(reconstructor.R, R, atol=1e-6 * np.abs(R).max())
    assert not np.any(G)
    assert not np.any(reconstructor.Q)
    assert reconstructor.provenance["method"] == "moao"
    assert reconstructor.provenance["target"] == target


def test_all_targets_together_are_the_mean_of_each(mini: System) -> None:
    """A pupil mirror has the same shape towards all of them, so eq. 19 is a weighted mean."""
    each = [moao(mini, target=i)[0].R[0] for i in range(2)]
    together = implicit(mini)[0].R[0]
    np.testing.assert_allclose((each[0] + 0.5 * each[1]) / 1.5, together, atol=1e-6 * np.abs(together).max())


def test_there_is_no_such_target(mini: System) -> None:
    with pytest.raises(ValueError, match="target: expected 0 to 1, got 2"):
        moao(mini, target=2)
