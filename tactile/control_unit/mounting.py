"""Pads with another mounting than in the layout: samples and forces in both orders. Pure."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tactile.frames.force_message import reordered_zero
from tactile.layout import PadMount, TaxelLayout, taxel_order
from tactile.source import Arrivals, ForceMessage


class Mounting:
    """Converts data of a control unit to the order of the layout, and back.

    Raises LayoutError as `tactile.layout.taxel_order`.

    Parameters
    ----------
    layout
        The taxels.
    mounts
        Pads with another mounting; without any the data stay unchanged.
    """

    def __init__(self, layout: TaxelLayout, mounts: Sequence[PadMount]) -> None:
        self._order = taxel_order(layout, mounts) if mounts else None
        gripping = layout.gripping_pads
        by_pad = {mount.pad: mount for mount in mounts}
        first, second = (by_pad.get(pad, PadMount(pad=pad, sent_as=pad)) for pad in gripping)
        self._exchanged = (first.sent_as, second.sent_as) == gripping[::-1]
        turns = {(one.rows_mirrored, one.columns_mirrored) for one in (first, second)}
        self.unit_can_sum = {first.sent_as, second.sent_as} == set(gripping) and len(turns) == 1
        """Whether the unit's force messages are valid. It sums its own two gripping pads and sends
        one centre for both."""
        self._signs = (-1 if first.rows_mirrored else 1, -1 if first.columns_mirrored else 1)
        own = np.concatenate([np.arange(layout.n_taxels)[layout.taxels_of(p)] for p in gripping])
        order = own if self._order is None else self._order[own]
        place = np.full(layout.n_taxels, -1)
        place[own] = np.arange(len(own))
        # Place of each taxel of the layout's gripping pads among those that the unit sums.
        self._zero_order = place[order] if self.unit_can_sum else np.arange(len(own))

    def arrivals(self, arrived: Arrivals) -> Arrivals:
        """Return frames and force messages of the unit in the order of the layout."""
        if self._order is None:
            return arrived
        frames = []
        for frame in arrived.frames:
            counts = frame.counts[self._order]
            counts.setflags(write=False)
            frames.append(replace(frame, counts=counts))
        return Arrivals(tuple(frames), tuple(map(self._force, arrived.forces)))

    def _force(self, message: ForceMessage) -> ForceMessage:
        """Return a force message of the unit with the forces of the layout's fingers."""
        first_n, second_n = message.force_n
        centre = message.centre_taxels
        along, across = self._signs
        return replace(
            message,
            force_n=(second_n, first_n) if self._exchanged else message.force_n,
            centre_taxels=None if centre is None else (along * centre[0], across * centre[1]),
        )

    def zero(self, zero: bytes) -> bytes:
        """Return object 0x2142 for the unit, given in the order of the layout."""
        if self._order is None:
            return zero
        return reordered_zero(zero, self._zero_order)
