"""Damage for valid inputs: seeded, fast, of the kinds that lines, disks and people do."""

import random
from collections.abc import Sequence

_TELLING = (
    0x00,
    0x01,
    0x7F,
    0x80,
    0xFD,
    0xFE,
    0xFF,
    0x0D,
    0x07,
    0x0A,
    0x22,
    0x2D,
    0x3A,
    0x5B,
    0x7B,
)
_WORST = 8


def mutated(rng: random.Random, data: bytes, others: Sequence[bytes] = ()) -> bytes:
    """Return the data with one to eight damages; ``others`` lend pieces."""
    out = bytearray(data)
    for _ in range(1 if rng.random() < 0.5 else rng.randint(2, _WORST)):
        _damage(rng, out, others)
    return bytes(out)


def _damage(rng: random.Random, out: bytearray, others: Sequence[bytes]) -> None:
    kind = rng.randrange(10)
    if not out:
        out += rng.randbytes(rng.randint(1, 8))
        return
    at = rng.randrange(len(out))
    size = min(rng.randint(1, 8) if rng.random() < 0.8 else rng.randint(1, 200), len(out) - at)
    if kind in (0, 1):
        out[at] ^= 1 << rng.randrange(8)
    elif kind == 2:
        out[at] = rng.choice(_TELLING)
    elif kind == 3:
        out[at] = rng.randrange(256)
    elif kind == 4:
        del out[at : at + size]
    elif kind == 5:
        out[at:at] = rng.randbytes(size)
    elif kind == 6:
        out[at:at] = out[at : at + size]
    elif kind == 7:
        out[at : at + size] = bytes(size)
    elif kind == 8:
        del out[at:]
    else:
        other = rng.choice(others) if others else bytes(out)
        begin = rng.randrange(len(other) + 1)
        out[at : at + size] = other[begin : begin + size]


def pieces(rng: random.Random, data: bytes) -> list[bytes]:
    """Cut data as a driver hands it out: whole, or in pieces of any size."""
    if rng.random() < 0.5 or len(data) < 2:
        return [data]
    cuts = sorted(rng.randrange(len(data)) for _ in range(rng.randint(1, 4)))
    return [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]
