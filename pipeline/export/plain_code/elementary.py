"""exp, log, tanh and what a softmax takes from + - * / alone, so that every processor computes the same bits.

A standard library's functions differ in their last bits from one system to the next. These are written in the few words
of Python that ``printed_functions`` puts into C, operation by operation: the Python text is the formula, the
reference of the tests, and the source of every printed text. Arithmetic is that of IEEE 754 with 53 bits, without
contraction. Each result is within one unit of its last place (``benchmarks/last_places.py`` measures it). A result too
large for a double is ``LARGEST``, with its sign. A softmax is as exact since its exponents, their exponentials and the
sum of these are kept in two parts: a double, and what it lacks, the rest.

Source: reduction and reconstruction as in Muller, Elementary Functions, 3rd ed., chapters 5 and 11; sums and products
in two parts as in Dekker, Numerische Mathematik 18, 1971. The coefficients are interpolants at Chebyshev nodes, made
with 60 digits.
"""

from __future__ import annotations

LARGEST = 1.7976931348623157e308  # of doubles
TINIEST = 2.2250738585072014e-308  # normal double
SHIFT = 6755399441055744.0  # 1.5 * 2^52: a number below 2^51 plus it, less it, is rounded to the nearest integer
LOG2_E = 1.4426950408889634  # 1/ln 2
LN2_HIGH, LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10  # the first of 32 bits: times an integer it is exact
MOST_EXP, LEAST_EXP = 709.782712893384, -745.1332191019412  # arguments: beyond them exp is no double
SQRT_2 = 1.4142135623730951  # where log halves its argument
LOW_TANH, HIGH_TANH = 0.75, 20.0  # below the first a rational function, from the second on 1

# exp r = 1 + r + r^2 q(r), |r| <= ln(2)/2; relative error 4e-19
EXP = (
    0.5, 0.1666666666666667, 0.04166666666666667, 0.008333333333326136, 0.0013888888888883748, 0.00019841269874820627,
    2.4801587325547743e-05, 2.7557255400206422e-06, 2.75572736431103e-07, 2.5105217004720745e-08,
    2.0914686968086876e-09,
)  # fmt: skip
# log((1 + s)/(1 - s)) = 2 s + s^3 l(s^2), s <= 3 - 2 sqrt 2; 6e-19
LOG = (
    0.6666666666666666, 0.40000000000000885, 0.28571428570799784, 0.22222222392581045, 0.18181795547521137,
    0.15386244737621665, 0.13268638369266825, 0.13088034850927555,
)  # fmt: skip
# tanh x = x + x^3 n(x^2)/d(x^2), |x| <= LOW_TANH; 9e-18
TANH_ABOVE = (-0.3333333333333333, -0.02141717864218934, -0.0002436483349790261, -1.7402064256825756e-08)
TANH_BELOW = (1.0, 0.464251535926568, 0.02452679747080311, 0.0002547024148604486)  # d
# powers of 2 from -544 by 32, and from 0 by 1
COARSE = tuple(2.0 ** (32 * i - 544) for i in range(35))
FINE = tuple(2.0**i for i in range(32))
OFFSET = 1088.0  # twice 544: powers of 2 count from it, so that no integer is negative
# powers of 2 by which log goes nearer to 1
DOUBLINGS = (512.0, 256.0, 128.0, 64.0, 32.0, 16.0, 8.0, 4.0, 2.0, 1.0)
UP = tuple(2.0**i for i in DOUBLINGS)
DOWN = tuple(2.0**-i for i in DOUBLINGS)
SPLIT = 134217729.0  # 2^27 + 1: a double times it gives the double's upper 26 bits
# 1.5 * 2^12: a number of [0, 1] plus it, less it, is a multiple of 2^-40, of which 4,096 have an exact sum
GRID = 6144.0
MOST_SUMMED = 4096  # numbers of a softmax at most: more multiples of 2^-40 up to 1 may have no exact sum


def plain_exp(x: float) -> float:
    """The exponential function; LARGEST where it is no double."""
    if x != x:  # NaN
        return x
    if x >= MOST_EXP:
        return LARGEST
    if x <= LEAST_EXP:
        return 0.0
    n: float = (x * LOG2_E + SHIFT) - SHIFT
    high: float = x - n * LN2_HIGH
    low: float = n * LN2_LOW
    r: float = high - low
    q: float = EXP[10]
    for i in range(10):
        q = q * r + EXP[9 - i]
    t: float = r + (((high - r) - low) + r * r * q)
    # 2^n in two factors, each a double, also where 2^n is none; integers from here on are not negative
    k: int = int(n + OFFSET)
    half: int = k // 2
    rest: int = k - half
    return (1.0 + t) * (COARSE[half // 32] * FINE[half % 32]) * (COARSE[rest // 32] * FINE[rest % 32])


def plain_exp_rest(x: float, rest: float) -> float:
    """The rest that ``plain_exp(x)`` lacks of the exponential of x + rest; 0 where x is no argument of it."""
    if x != x:  # NaN
        return 0.0
    if x >= MOST_EXP:
        return 0.0
    if x <= LEAST_EXP:
        return 0.0
    n: float = (x * LOG2_E + SHIFT) - SHIFT
    high: float = x - n * LN2_HIGH
    low: float = n * LN2_LOW
    r: float = high - low
    q: float = EXP[10]
    for i in range(10):
        q = q * r + EXP[9 - i]
    c: float = ((high - r) - low) + r * r * q
    t: float = r + c
    one: float = 1.0 + t
    left: float = (t - (one - 1.0)) + (c - (t - r)) + rest * one
    k: int = int(n + OFFSET)
    half: int = k // 2
    part: int = k - half
    return left * (COARSE[half // 32] * FINE[half % 32]) * (COARSE[part // 32] * FINE[part % 32])


def plain_difference_rest(above: float, below: float) -> float:
    """The rest that the double above - below lacks of the difference."""
    d: float = above - below
    back: float = d - above
    return (above - (d - back)) - (below + back)


def plain_quotient(above: float, above_rest: float, below: float, below_rest: float) -> float:
    """(above + above_rest) / (below + below_rest), each a double and what it lacks."""
    found: float = above / below
    wide: float = found * SPLIT
    head: float = wide - (wide - found)
    tail: float = found - head
    broad: float = below * SPLIT
    upper: float = broad - (broad - below)
    lower: float = below - upper
    product: float = found * below
    lacks: float = ((head * upper - product) + head * lower + tail * upper) + tail * lower
    return found + (((above - product) - lacks) + (above_rest - found * below_rest)) / below


def plain_log(x: float) -> float:
    """The natural logarithm; -LARGEST where x is not positive."""
    if x <= 0.0:
        return -LARGEST
    m: float = x
    e: float = 0.0
    if m < TINIEST:
        m = m * 18014398509481984.0
        e = -54.0
    for i in range(10):
        if m >= UP[i]:
            m = m * DOWN[i]
            e = e + DOUBLINGS[i]
    if m < 1.0:
        for i in range(10):
            if m * UP[i] < 2.0:
                m = m * UP[i]
                e = e - DOUBLINGS[i]
    if m > SQRT_2:
        m = 0.5 * m
        e = e + 1.0
    f: float = m - 1.0
    s: float = f / (2.0 + f)
    z: float = s * s
    q: float = LOG[7]
    for i in range(7):
        q = q * z + LOG[6 - i]
    h: float = 0.5 * f * f
    return e * LN2_HIGH - ((h - (s * (h + z * q) + e * LN2_LOW)) - f)


def plain_tanh(x: float) -> float:
    """The hyperbolic tangent."""
    if x != x:  # NaN
        return x
    size: float = x if x >= 0.0 else -x
    if size < LOW_TANH:
        z: float = x * x
        above: float = ((TANH_ABOVE[3] * z + TANH_ABOVE[2]) * z + TANH_ABOVE[1]) * z + TANH_ABOVE[0]
        below: float = ((TANH_BELOW[3] * z + TANH_BELOW[2]) * z + TANH_BELOW[1]) * z + TANH_BELOW[0]
        return x + x * z * (above / below)
    if size >= HIGH_TANH:
        return 1.0 if x > 0.0 else -1.0
    # 1 - 2/(e^(2 size) + 1), where e^(2 size) + 1 = d + left
    twice: float = 2.0 * size
    n: float = (twice * LOG2_E + SHIFT) - SHIFT
    high: float = twice - n * LN2_HIGH
    low: float = n * LN2_LOW
    r: float = high - low
    q: float = EXP[10]
    for i in range(10):
        q = q * r + EXP[9 - i]
    t: float = r + (((high - r) - low) + r * r * q)
    one: float = 1.0 + t
    k: int = int(n)
    power: float = COARSE[17 + k // 32] * FINE[k % 32]
    grown: float = one * power
    d: float = grown + 1.0
    left: float = (grown - (d - 1.0)) + (t - (one - 1.0)) * power
    y: float = 2.0 / d
    near: float = 1.0 - y
    found: float = near + (((1.0 - near) - y) + y * (left / d))
    return found if x > 0.0 else -found
