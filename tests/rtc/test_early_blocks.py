"""Blocks without a use are bounded, however many come, and however often."""

from srtomo_core.wire import ReconstructorBlock
from srtomo_rtc.early_blocks import EarlyBlocks


def block(name: bytes, number: int, rows: int = 0) -> ReconstructorBlock:
    return ReconstructorBlock(0, name * 32, number, 0, 0, rows, None)


def test_the_same_one_again_is_kept_once_and_the_newest_counts():
    early = EarlyBlocks()
    for rows in range(50):
        early.keep(block(b"a", rows % 3, rows))
    assert len(early) == 3
    assert [kept.first_row for kept in early.take(b"a" * 32)] == [48, 49, 47]
    assert len(early) == 0


def test_two_reconstructors_at_most():
    """Of many that come by turns the awaited one's blocks stay; without one the newest two's."""
    names = [bytes([name]) for name in b"abcdef"]
    for awaited, kept in ((None, b"ef"), (b"a", b"af")):
        early = EarlyBlocks()
        for name in names:
            for number in range(4):
                early.keep(block(name, number), awaited and awaited * 32)
                if awaited:
                    early.keep(block(awaited, number), awaited * 32)
        assert len(early) == 8
        assert early.take(bytes([kept[0]]) * 32) and not len(early)
        assert not early.take(bytes([kept[1]]) * 32)  # blocks of others go with it: they can be asked for
