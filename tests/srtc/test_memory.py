"""What does not fit is refused beforehand."""

import pytest

from srtomo_srtc import memory


def test_room_for_little_and_not_for_everything() -> None:
    memory.require(1, "a byte")
    with pytest.raises(MemoryError, match=r"^everything: needs 931322574\.6 GiB of memory, \d+\.\d GiB are available$"):
        memory.require(1e18, "everything")


def test_available_is_what_the_host_has_or_less() -> None:
    assert 0 < memory.available() < 1e15
