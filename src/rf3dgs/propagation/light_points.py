"""Well-spread points in the unit square for light paths: Sobol's first two dimensions, shuffled and scrambled.

B. Burley, "Practical hash-based Owen scrambling", JCGT 9(4), 2020: every pixel and every use within a light path has a
sequence of its own, whose first n points are evenly spread for any n. Arrays are Dr.Jit's unsigned integers.
"""

from typing import Any

UInt = Any
Float = Any


def hashed(value: UInt) -> UInt:
    """A number in which every bit depends on every bit of `value` (finalizer of MurmurHash3)."""
    value = (value ^ (value >> 16)) * 0x85EBCA6B
    value = (value ^ (value >> 13)) * 0xC2B2AE35
    return value ^ (value >> 16)


def unit(value: UInt) -> Float:
    """The number in [0, 1) that the upper 24 bits of `value` are."""
    import mitsuba

    return mitsuba.Float(value >> 8) * 2.0**-24


def point(number: UInt, seed: UInt) -> tuple[Float, Float]:
    """Point `number` of the sequence `seed`, both coordinates in [0, 1)."""
    import drjit as dr

    shuffled = _scrambled(dr.brev(number), seed)  # bits reversed, and so the first of Sobol's coordinates
    other = shuffled
    # The second is the Taylor shift i(1 + x) of the polynomial whose coefficients are the bits, the lowest one first.
    for width, low in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        other = other ^ ((other & low) << width)
    first = dr.brev(_scrambled(dr.brev(shuffled), hashed(seed ^ 0x5BD1E995)))
    second = dr.brev(_scrambled(dr.brev(other), hashed(seed ^ 0x27D4EB2F)))
    return unit(first), unit(second)


def _scrambled(bits: UInt, seed: UInt) -> UInt:
    """Bits of which each is flipped or not by those below it and the seed: Owen's scrambling of the reversed number."""
    bits = bits + seed
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):  # from the article
        bits = bits ^ (bits * factor)
    return bits
