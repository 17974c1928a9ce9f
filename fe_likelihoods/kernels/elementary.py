"""Logarithm and exponential without calls or branches, so that a loop over bars becomes SIMD code.

Both take the exponent of the double from its bits, and a series for the rest::

    v = 2^k m,  z = (m-1)/(m+1):   ln v  = k ln 2 + 2 (z + z^3/3 + z^5/5 + ...),   1/sqrt(2) <= m < sqrt(2)
    k = round(y / ln 2):           exp y = 2^k (1 + g + g^2/2! + ...),   g = y - k ln 2

The terms that are left out are below 1e-17 of the result. The error is two units in the last place.
"""

from __future__ import annotations

import struct

from numba import types
from numba.extending import intrinsic, overload

from .jit import kernel

__all__ = ["exp", "log"]

_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # ln 2; k times the first is exact
_ROUND = 1.5 * 2.0**52  # a double of this size has its unit in the last bit
_ROUND_BITS = 0x4338000000000000
_HALF_ROOT_BITS = 0x3FE6A09E667F3BCD  # of 1/sqrt(2)


def _bits(value):
    """Return the bits of a double as an integer."""
    return struct.unpack("<q", struct.pack("<d", value))[0]


def _double(bits):
    """Return the double with these bits."""
    return struct.unpack("<d", struct.pack("<q", bits))[0]


def _cast(function, source, target):
    """Give a compiled kernel a bitcast for `function`."""

    @intrinsic
    def cast(context, argument):
        def generate(context, builder, signature, arguments):
            return builder.bitcast(arguments[0], context.get_value_type(target))

        return target(source), generate

    @overload(function, inline="always")
    def implementation(argument):
        return lambda argument: cast(argument)


_cast(_bits, types.float64, types.int64)
_cast(_double, types.int64, types.float64)


@kernel(inline=True, fastmath={"contract"})
def log(v):
    """Return ln v of a normal number v > 0; any other v gives a finite number without a meaning."""
    bits = _bits(v)
    k = (bits - _HALF_ROOT_BITS) >> 52
    m = _double(bits - (k << 52))
    e = _double(k + _ROUND_BITS) - _ROUND
    z = (m - 1.0) / (m + 1.0)
    w = z * z
    w2 = w * w
    w4 = w2 * w2
    s = (1.0 / 3.0 + w * (1.0 / 5.0)) + w2 * (1.0 / 7.0 + w * (1.0 / 9.0))
    s += w4 * ((1.0 / 11.0 + w * (1.0 / 13.0)) + w2 * (1.0 / 15.0 + w * (1.0 / 17.0)))
    s += w4 * w4 * (1.0 / 19.0 + w * (1.0 / 21.0))
    return e * _LN2_HIGH + (e * _LN2_LOW + (2.0 * z * w * s + 2.0 * z))


@kernel(inline=True, fastmath={"contract"})
def exp(y):
    """Return exp y for abs(y) < 700; any other y gives a number without a meaning."""
    rounded = y * 1.4426950408889634 + _ROUND
    k = _bits(rounded) - _ROUND_BITS
    e = rounded - _ROUND
    g = (y - e * _LN2_HIGH) - e * _LN2_LOW
    g2 = g * g
    g4 = g2 * g2
    s = (1.0 / 40320.0 + g * (1.0 / 362880.0)) + g2 * (1.0 / 3628800.0 + g * (1.0 / 39916800.0))
    s += g4 * (1.0 / 479001600.0 + g * (1.0 / 6227020800.0))
    s = (1.0 / 24.0 + g * (1.0 / 120.0)) + g2 * (1.0 / 720.0 + g * (1.0 / 5040.0)) + g4 * s
    s = (1.0 + g) + (g2 * (0.5 + g * (1.0 / 6.0)) + g4 * s)
    return s * _double((k + 1023) << 52)
