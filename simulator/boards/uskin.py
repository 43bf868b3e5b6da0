"""uSkin boards on CAN, and the physics of their pads: silicone over magnets and sensors."""

import struct
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from simulator.boards.site import BoardSite, SimulatedBoards
from simulator.can.node import SendBurst
from simulator.clock import ROUNDING_S

_START = bytes((7, 0))
_PERIOD_S = 0.01
_REST = (0x7E31, 0x7E31, 0x9312)
"""Samples of x, y and z at rest."""
_SPREAD_COUNTS = 900.0
"""Standard deviation of the rest values of z between taxels. [assumed]"""
_JITTER = 0.02
_NEIGHBOURS = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, slots=True, kw_only=True)
class UskinBoard:
    """Identifiers of one board."""

    start_id: int
    taxel_ids: tuple[int, ...]


_COUNTS_PER_N = 3000.0
"""Counts of z of a taxel for a small force. [assumed, as the further figures]"""
_LIMIT_N = 12.0
"""Force in N at which the silicone is compressed to its base."""
_CROSSTALK = 0.12
"""Share of a taxel's force that each neighbour also measures."""
_HYSTERESIS = 0.06
"""Share by which a taxel stays above a falling force."""
_NOISE_COUNTS = 12.0
"""Standard deviation of the noise."""
_DRIFT_COUNTS_S = 5.0
"""Drift of z of a pad: 1,000 counts in some minutes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UskinSettings(SimulatedBoards):
    """Two boards on one bus."""

    boards: tuple[UskinBoard, UskinBoard]
    """The boards of finger 0 and finger 1."""
    falling: bool = False
    """Whether z falls under a force."""

    def can_device(self, site: BoardSite) -> "SimulatedUskin":
        """Return both boards."""
        return SimulatedUskin(self, site)


class SimulatedUskin:
    """Two boards; implements `simulator.can.link.CanDevice`."""

    def __init__(self, settings: UskinSettings, site: BoardSite) -> None:
        self._world, self._layout, self._settings = site.world, site.layout, settings
        self._faults, self._taxel_faults = site.faults, site.taxel_faults
        self._rng = np.random.default_rng([site.seed, 5])
        self.send: SendBurst
        """Sends messages; see `simulator.can.link.CanDevice`."""
        self._due_s = [inf, inf]
        self._drift = self._rng.uniform(0.5, 1.5, 2) * _DRIFT_COUNTS_S
        self._drifted = np.zeros(site.layout.n_taxels)
        self._rest = _REST[2] + self._rng.normal(0.0, _SPREAD_COUNTS, site.layout.n_taxels)
        self._lagging_n = np.zeros(site.layout.n_taxels)
        self._now_s = site.start_s

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        """Start the board that has this start message."""
        for finger, board in enumerate(self._settings.boards):
            if (can_id, data) == (board.start_id, _START):
                self._due_s[finger] = now_s + self._rng.uniform(0.2, 1.0) * _PERIOD_S

    def advance(self, now_s: float) -> None:
        """Send the cycles that are due until ``now_s`` s."""
        self._now_s = max(self._now_s, now_s)
        for finger in (0, 1):
            if finger in self._faults.low_supply:
                self._due_s[finger] = inf
            if self._due_s[finger] < now_s - 10.0 * _PERIOD_S:
                self._due_s[finger] = now_s
            while self._due_s[finger] <= now_s + ROUNDING_S:
                self._cycle(finger, self._due_s[finger])
                jitter = 1.0 + _JITTER * self._rng.standard_normal()
                self._due_s[finger] += _PERIOD_S * max(0.5, jitter)

    def next_event_s(self) -> float:
        """Return when the next cycle is due, in s."""
        return min(self._due_s)

    def _cycle(self, finger: int, now_s: float) -> None:
        if finger in self._faults.off:
            return
        taxels = self._layout.taxels_of(self._layout.gripping_pads[finger])
        for _ in range(2 if finger in self._faults.doubled else 1):
            z = self._scan(finger)[taxels]
            shear = np.rint(_REST[0] + self._rng.normal(0.0, _NOISE_COUNTS, (len(z), 2)))
            ids = self._settings.boards[finger].taxel_ids
            for can_id, (x, y), sample in zip(ids, shear.tolist(), z.tolist(), strict=True):
                self.send(now_s, can_id, [struct.pack(">BHHH", 0, int(x), int(y), sample)])

    def _scan(self, finger: int) -> NDArray[np.uint16]:
        """Return z of all taxels (n_taxels,); each scan advances the drift of its board."""
        taxels = self._layout.taxels_of(self._layout.gripping_pads[finger])
        self._drifted[taxels] += (self._drift[finger] + self._faults.drift_counts_s) * _PERIOD_S
        force_n = self._world.measured_force_n()
        self._lagging_n = np.clip(self._lagging_n, force_n, (1.0 + _HYSTERESIS) * force_n)
        compressed_n = _LIMIT_N * np.tanh(self._lagging_n / _LIMIT_N)
        for number in range(self._layout.n_pads):
            taxels = self._layout.taxels_of(number)
            matrix = compressed_n[taxels].reshape(self._layout.pad_shape[number])
            neighbours = ndimage.convolve(matrix, _NEIGHBOURS, mode="constant")
            compressed_n[taxels] = (matrix + _CROSSTALK * neighbours).ravel()
        pull = _COUNTS_PER_N * compressed_n
        z = self._rest + self._drifted + (-pull if self._settings.falling else pull)
        z += self._rng.normal(0.0, _NOISE_COUNTS, z.shape)
        counts = np.clip(np.rint(z), 0, 0xFFFF).astype(np.uint16)
        return self._taxel_faults.apply(counts, 0xFFFF)
