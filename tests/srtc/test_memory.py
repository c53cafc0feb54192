"""What does not fit is refused beforehand."""

import importlib
import tracemalloc
from typing import Any

import pytest

from srtomo_core.system import System, load_system
from srtomo_srtc import memory
from srtomo_srtc.reconstructors import METHODS


@pytest.fixture(scope="module")
def system() -> System:
    """Sensors that are only shifted, as ``iterative`` needs them, and enough slopes for matrices to count most."""
    lasers = {f"sensors.{i}.{key}": value for i in range(3) for key, value in (("rotation", 0.0), ("subapertures", 14))}
    return load_system("mini", {**lasers, "guide_stars.2.altitude": 90e3, "telescope.obscuration": 0.1})


@pytest.fixture(scope="module")
def larger() -> System:
    """Matrices that outweigh the geometry also where no covariance is held."""
    return load_system("gnao_ltao_sr")


def test_room_for_little_and_not_for_everything() -> None:
    memory.require(1, "a byte")
    with pytest.raises(MemoryError, match=r"^everything: needs 931322574\.6 GiB of memory, \d+\.\d GiB are available$"):
        memory.require(1e18, "everything")


def test_available_is_what_the_host_has_or_less() -> None:
    assert 0 < memory.available() < 1e15


@pytest.mark.parametrize("method", METHODS)
def test_every_method_refuses_what_does_not_fit(method: str, system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 1e3)
    with pytest.raises(MemoryError, match=r"needs \d\.\d GiB of memory, 0\.0 GiB are available$"):
        METHODS[method](system)


@pytest.mark.parametrize(
    ("method", "keywords", "enough"),
    [
        ("learn_apply", {}, "system"),
        ("modal", {}, "system"),
        ("implicit", {"split": True}, "larger"),
        ("least_squares", {}, "larger"),
        ("glao", {}, "larger"),
    ],
)
def test_what_it_says_is_what_it_needs(
    method: str, keywords: dict[str, Any], enough: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not less, and not much more."""
    METHODS[method](load_system("mini"), **keywords)  # compiles
    stated: list[float] = []
    module = importlib.import_module(f"srtomo_srtc.reconstructors.{method}")  # the function has the same name
    monkeypatch.setattr(module, "require", lambda n_bytes, _: stated.append(n_bytes))
    tracemalloc.start()
    METHODS[method](request.getfixturevalue(enough), **keywords)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    print(method, peak / stated[0])
    assert 0.5 * stated[0] < peak < 1.15 * stated[0]
