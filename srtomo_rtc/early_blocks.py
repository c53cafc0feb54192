"""Blocks of a reconstructor that come before there is a use for them: manifest and blocks are two topics."""

from __future__ import annotations

from srtomo_core.wire import ReconstructorBlock

_RECONSTRUCTORS = 2


class EarlyBlocks:
    """Each block once, and of two reconstructors at most: the one that is waited for, if any, and the newest others'.

    Nobody may ever use them: an HRTC that is not configured hears every SRTC there is.
    """

    def __init__(self) -> None:
        self._blocks: dict[bytes, dict[int, ReconstructorBlock]] = {}

    def keep(self, block: ReconstructorBlock, awaited: bytes | None = None) -> None:
        """Keep a block.

        Args:
            awaited: SHA-256 of the reconstructor whose manifest has come; its blocks outlast those of others.
        """
        blocks = self._blocks.pop(block.sha256, {})
        blocks[block.number] = block
        self._blocks[block.sha256] = blocks  # the newest is the last
        if len(self._blocks) > _RECONSTRUCTORS:
            del self._blocks[next(sha256 for sha256 in self._blocks if sha256 != awaited)]

    def take(self, sha256: bytes) -> list[ReconstructorBlock]:
        """Those of a reconstructor, each once; nothing is kept any more."""
        taken = list(self._blocks.get(sha256, {}).values())
        self._blocks.clear()
        return taken

    def __len__(self) -> int:
        return sum(map(len, self._blocks.values()))
