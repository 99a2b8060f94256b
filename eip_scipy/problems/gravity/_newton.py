"""The equations and invariants of N point masses, compiled; sums over pairs in eight explicit lanes.

A block of 8, 4 or 2 targets meets all bodies as sources. With less than 8 targets the lanes form 2 or 4 streams, each
with its share of the sources, added at the end. The last block overlaps the one before it, so that no lane reads past
the arrays. Accelerations take every pair twice, once for each body: that costs less than sums across lanes for the
reactions, and keeps the momentum as well, for r_ij and 1/r_ij^3 are the same in both, bit for bit.

Powers of 1/r come without square root and division, which are slow in vectors: an estimate from the bits of r^2, a
polynomial, a correction to full precision. All of it is integer arithmetic, multiplication, addition and fused
multiply-add, so that the bits are the same on every processor that has the latter, and multiplying all lengths by a
power of two stays exact. Distances between 1e-100 and 1e150 will do in any unit; bodies at one place give NaN.

The energy, in which large terms nearly cancel, is summed with the rounding errors carried along: what a projection
cannot see it cannot correct.

What is compiled here and calls the lanes stays in this file: Numba's cache on disk looks only at a function's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

from ...engine.caching import cached_njit
from ...engine.octets import OCTET, in_octets, multiply_add, on_stack, over_members, spread

__all__ = ["acc", "energy", "energy_gradient", "momentum", "momentum_gradient", "rhs"]

LANES = 8
DOUBLE, INDEX = ir.DoubleType(), ir.IntType(64)
VECTOR, BITS = ir.VectorType(DOUBLE, LANES), ir.VectorType(INDEX, LANES)

# x^-1/2 to 6.3e-7: y from the bits of x, times a minimax cubic in x y^2. The constant is the one that leaves the least
# range of x y^2, [0.912, 1.040]; the cubic is that of Remez for it.
ESTIMATE = 0x5FE6996542967F58
MOST_SUMS = 3 * 2 * 7  # floats of `_accelerations_of_members` in streams, at seven bodies
CUBIC = (2.216453840039739, -2.274298221857139, 1.3991927078645605, -0.3413483382980669)


def _index(k: int) -> Any:  # emits LLVM
    return ir.Constant(INDEX, k)


def _lane(k: int) -> Any:  # emits LLVM
    return ir.Constant(ir.IntType(32), k)


def _constant(values: Any) -> Any:  # emits LLVM
    return ir.Constant(VECTOR, np.broadcast_to(np.asarray(values, dtype=float), LANES).tolist())


class _Entries:  # emits LLVM
    """The entries of a 1-D array, by pointer; vectors at once where they are contiguous."""

    def __init__(self, builder: Any, kind: Any, array: Any, start: Any = None) -> None:
        self.builder, self.kind, self.array = builder, kind, array
        self.start = _index(0) if start is None else start

    def after(self, start: Any) -> _Entries:
        return _Entries(self.builder, self.kind, self.array, self.builder.add(self.start, start))

    def _pointer(self, i: Any) -> Any:
        b = self.builder
        i = b.add(self.start, i)
        if self.kind.layout == "C":
            return b.gep(self.array.data, [i])
        stride = b.extract_value(self.array.strides, 0)
        return cgutils.pointer_add(b, self.array.data, b.mul(stride, i), DOUBLE.as_pointer())

    def __getitem__(self, i: Any) -> Any:
        return self.builder.load(self._pointer(i))

    def load(self, i: Any, count: int) -> Any:
        """Entries i ... i + count - 1."""
        b, kind = self.builder, ir.VectorType(DOUBLE, count)
        if self.kind.layout == "C":
            return b.load(b.bitcast(self._pointer(i), kind.as_pointer()), align=8)
        vector = ir.Constant(kind, ir.Undefined)
        for k in range(count):
            vector = b.insert_element(vector, self[b.add(i, _index(k))], _lane(k))
        return vector

    def store(self, vector: Any, i: Any) -> None:
        b = self.builder
        if self.kind.layout == "C":
            b.store(vector, b.bitcast(self._pointer(i), vector.type.as_pointer()), align=8)
            return
        for k in range(vector.type.count):
            b.store(b.extract_element(vector, _lane(k)), self._pointer(b.add(i, _index(k))))


class _Lanes:  # emits LLVM
    """Emits instructions on vectors of eight lanes."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        """The sum a b + c, rounded once where the processor can."""
        kind = ir.FunctionType(VECTOR, [VECTOR] * 3)
        fma = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.fmuladd.v{LANES}f64")
        return self.builder.call(fma, [a, b, c])

    def pick(self, a: Any, places: Sequence[int] | np.ndarray, b: Any = None) -> Any:
        """The entries of a, or of a followed by b, at constant places."""
        mask = ir.Constant(ir.VectorType(ir.IntType(32), len(places)), [int(k) for k in places])
        return self.builder.shuffle_vector(a, ir.Constant(a.type, ir.Undefined) if b is None else b, mask)

    def spread(self, number: Any) -> Any:
        """One number in all lanes."""
        first = self.builder.insert_element(ir.Constant(VECTOR, ir.Undefined), number, _lane(0))
        return self.pick(first, [0] * LANES)

    def row(self, name: str, rows: np.ndarray, k: Any) -> Any:
        """Row k of a constant table, k brought into its range."""
        last = _index(len(rows) - 1)
        k = self.builder.select(self.builder.icmp_signed("<", k, _index(0)), _index(0), k)
        k = self.builder.select(self.builder.icmp_signed(">", k, last), last, k)
        values = ir.Constant(ir.ArrayType(VECTOR, len(rows)), [_constant(row) for row in rows])
        table = cgutils.global_constant(self.builder, name, values)
        return self.builder.load(self.builder.gep(table, [_index(0), k]), align=8)

    def squares(self, d: Sequence[Any], start: Any) -> Any:
        """The sum start + d_x^2 + d_y^2 + d_z^2."""
        for a in d:
            start = self.fma(a, a, start)
        return start

    def fold(self, vector: Any, width: int) -> Any:
        """Lanes k, k + width, k + 2 width, ... added, by halves."""
        while vector.type.count > width:
            vector = self.builder.fadd(*self.halves(vector))
        return vector

    def halves(self, vector: Any) -> tuple[Any, Any]:
        half = vector.type.count // 2
        return self.pick(vector, range(half)), self.pick(vector, range(half, 2 * half))

    def carried_product(self, a: Any, b: Any, total: Any, carry: Any) -> tuple[Any, Any]:
        """The sum total + carry + a b as a new (total, carry)."""
        new = self.fma(a, b, total)
        lost = self.fma(a, b, self.builder.fsub(total, new))
        return new, self.builder.fadd(carry, lost)

    def carried_sum(self, a: Any, b: Any) -> tuple[Any, Any]:
        """The sum a + b and its rounding error (Knuth)."""
        add, subtract = self.builder.fadd, self.builder.fsub
        total = add(a, b)
        part = subtract(total, a)
        return total, add(subtract(a, subtract(total, part)), subtract(b, part))

    def carried_fold(self, total: Any, carry: Any) -> Any:
        """All lanes of total + carry, added by halves."""
        while total.type.count > 1:
            total, lost = self.carried_sum(*self.halves(total))
            carry = self.builder.fadd(self.builder.fadd(*self.halves(carry)), lost)
        return self.builder.extract_element(self.builder.fadd(total, carry), _lane(0))

    def root_estimate(self, x: Any) -> Any:
        """x^-1/2 to 6.3e-7."""
        b = self.builder
        half = b.lshr(b.bitcast(x, BITS), ir.Constant(BITS, [1] * LANES))
        y = b.bitcast(b.sub(ir.Constant(BITS, [ESTIMATE] * LANES), half), VECTOR)
        c = b.fmul(b.fmul(x, y), y)
        p = _constant(CUBIC[3])
        for a in CUBIC[2::-1]:
            p = self.fma(p, c, _constant(a))
        return b.fmul(y, p)

    def over_distance(self, x: Any) -> Any:
        """x^-1/2, nearly always rounded correctly: y (1 + h/2 + 3/8 h^2), h = 1 - x y^2 without the rounding of y^2."""
        b = self.builder
        y = self.root_estimate(x)
        y2, minus_x = b.fmul(y, y), b.fneg(x)
        h = self.fma(minus_x, self.fma(y, y, b.fneg(y2)), self.fma(minus_x, y2, _constant(1.0)))
        return self.fma(b.fmul(y, h), self.fma(_constant(3 / 8), h, _constant(1 / 2)), y)

    def over_cube(self, m: Any, x: Any) -> Any:
        """The quotient m / x^(3/2): y^3 (1 + 3/2 h + 15/8 h^2), h = 1 - x y^2."""
        b = self.builder
        y = self.root_estimate(x)
        y2 = b.fmul(y, y)
        h = self.fma(b.fneg(x), y2, _constant(1.0))
        m = b.fmul(b.fmul(m, y), y2)
        return self.fma(b.fmul(m, h), self.fma(_constant(15 / 8), h, _constant(3 / 2)), m)


class _Sources(_Lanes):  # emits LLVM
    """Bodies as they meet `targets` others: lane k holds target k % targets and source k // targets of a group."""

    def __init__(self, builder: Any, q: _Entries, gm: _Entries, targets: int) -> None:
        super().__init__(builder)
        self.q, self.gm = q, gm
        self.targets, self.streams = targets, LANES // targets
        self.target, self.stream = np.arange(LANES) % targets, np.arange(LANES) // targets

    def own(self, entries: _Entries, first: Any) -> list[Any]:
        """The targets' x, y and z."""
        vectors = entries.load(self.builder.mul(first, _index(3)), 3 * self.targets)
        return [self.pick(vectors, 3 * self.target + c) for c in range(3)]

    def group(self, j: Any) -> tuple[list[Any], Any]:
        """The sources j ... j + streams - 1: [x, y, z], G m."""
        place = self.builder.mul(j, _index(3))
        if self.streams == 1:
            q = [self.spread(self.q[self.builder.add(place, _index(c))]) for c in range(3)]
            return q, self.spread(self.gm[j])
        near, gm = self.q.load(place, 3 * self.streams), self.gm.load(j, self.streams)
        return [self.pick(near, 3 * self.stream + c) for c in range(3)], self.pick(gm, self.stream)

    def itself(self, d: Any) -> Any:
        """1 where source and target are one body, else 0; d is the first source less the first target."""
        rows = self.target - self.stream == np.arange(-self.streams, self.targets + 1)[:, None]
        return self.row(f"eip_itself_{self.targets}", rows, self.builder.add(d, _index(self.streams)))

    def below(self, k: Any) -> Any:
        """1 in the streams 0 ... k - 1, else 0."""
        rows = self.stream < np.arange(self.streams)[:, None]
        return self.row(f"eip_below_{self.targets}", rows, k)


def _emit_accelerations(s: _Sources, n: Any, out: _Entries, first: Any) -> None:  # emits LLVM
    b = s.builder
    x = s.own(s.q, first)
    total = [cgutils.alloca_once_value(b, _constant(0.0)) for _ in range(3)]

    def add(j: Any, used: Any = None) -> None:
        near, gm = s.group(j)
        if used is not None:
            gm = b.fmul(gm, used)
        d = [b.fsub(a, c) for a, c in zip(near, x, strict=True)]
        # A body's own pull is 0 / 1.
        w = s.over_cube(gm, s.squares(d, s.itself(b.sub(j, first))))
        for a, sum_ in zip(d, total, strict=True):
            b.store(s.fma(w, a, b.load(sum_)), sum_)

    streams = _index(s.streams)
    start = b.urem(n, streams)
    if s.streams > 1:
        with b.if_then(b.icmp_unsigned("!=", start, _index(0))):
            add(_index(0), s.below(start))
    with cgutils.for_range_slice(b, start, n, streams, INDEX) as (j, _):
        add(j)
    ax, ay, az = (s.fold(b.load(sum_), s.targets) for sum_ in total)
    m = s.targets
    xy, z = s.pick(ax, range(2 * m), ay), s.pick(az, [*range(m), *range(m)])
    out.store(s.pick(xy, [c * m + k for k in range(m) for c in range(3)], z), b.mul(first, _index(3)))


def _emit_potential(s: _Sources, n: Any, first: Any, begin: Any, from_row: np.ndarray) -> tuple[Any, Any]:  # emits LLVM
    """The potential of each target in the field of those after it, from `begin` on, with its carry."""
    b = s.builder
    x = s.own(s.q, first)
    potential, carry = (cgutils.alloca_once_value(b, _constant(0.0)) for _ in range(2))
    with cgutils.for_range_slice(b, begin, n, _index(1), INDEX) as (j, _):
        near, gm = s.group(j)
        d = [b.fsub(a, c) for a, c in zip(near, x, strict=True)]
        # Not the body itself, nor those after it in the block, which meet this one as a source.
        done = s.row("eip_from_row", from_row, b.sub(j, first))
        gm = s.fma(b.fneg(gm), done, gm)
        over_r = s.over_distance(s.squares(d, done))
        new = s.carried_product(gm, over_r, b.load(potential), b.load(carry))
        b.store(new[0], potential)
        b.store(new[1], carry)
    return b.load(potential), b.load(carry)


def _emit_energy(s: _Sources, n: Any, first: Any, skip: Any) -> Any:  # emits LLVM
    b, zero = s.builder, _constant(0.0)
    from_row = np.arange(LANES) >= np.arange(LANES + 1)[:, None]
    begin = b.add(b.add(first, skip), _index(1))
    potential, potential_carry = _emit_potential(s, n, first, begin, from_row)
    square = zero, zero
    for v in s.own(s.q.after(b.mul(n, _index(3))), first):
        square = s.carried_product(v, v, *square)
    kinetic, carry = (b.fmul(part, _constant(0.5)) for part in square)
    energy, lost = s.carried_sum(kinetic, b.fneg(potential))
    carry = b.fadd(lost, b.fsub(carry, potential_carry))
    gm = b.fmul(s.gm.load(first, LANES), s.row("eip_from_row", from_row, skip))
    total, lost = s.carried_product(gm, energy, zero, zero)
    return s.carried_fold(total, s.fma(gm, carry, lost))


def _entries(context: Any, builder: Any, signature: Any, arguments: Any, k: int) -> _Entries:  # emits LLVM
    kind = signature.args[k]
    return _Entries(builder, kind, context.make_array(kind)(context, builder, arguments[k]))


def _require_vectors(*kinds: Any) -> None:  # emits LLVM
    for kind in kinds:
        if not (isinstance(kind, types.Array) and kind.ndim == 1 and kind.dtype == types.float64):
            raise TypingError(f"N bodies: expected a vector of float64, got {kind}")


def _acceleration_block(targets: int) -> Any:  # emits LLVM
    """``block(q, gm, out, first)`` for the bodies first ... first + targets - 1."""

    @intrinsic
    def block(typingctx, q, gm, out, first):
        _require_vectors(q, gm, out)

        def codegen(context, builder, signature, arguments):
            q, gm, out = (_entries(context, builder, signature, arguments, k) for k in range(3))
            _emit_accelerations(_Sources(builder, q, gm, targets), gm.array.nitems, out, arguments[3])
            return context.get_dummy_value()

        return types.void(q, gm, out, types.intp), codegen

    return block


@intrinsic  # emits LLVM
def _energy_block(typingctx, y, gm, first, skip):
    """Energy of the bodies first + skip ... first + 7, with the pairs that they make with later ones."""
    _require_vectors(y, gm)

    def codegen(context, builder, signature, arguments):
        y, gm = (_entries(context, builder, signature, arguments, k) for k in range(2))
        return _emit_energy(_Sources(builder, y, gm, LANES), gm.array.nitems, *arguments[2:])

    return types.float64(y, gm, types.intp, types.intp), codegen


_accelerations_8, _accelerations_4, _accelerations_2 = (_acceleration_block(targets) for targets in (8, 4, 2))


if config.DISABLE_JIT:

    def _numpy_block(targets):
        def block(q, gm, out, first):
            bodies = np.arange(targets)
            q = q.reshape(-1, 3)
            d = q - q[first : first + targets, None]
            r2 = np.sum(d * d, axis=2)
            r2[bodies, first + bodies] = 1.0
            w = gm / (r2 * np.sqrt(r2))
            out[3 * first : 3 * (first + targets)] = np.sum(w[:, :, None] * d, axis=1).ravel()

        return block

    _accelerations_8, _accelerations_4, _accelerations_2 = (_numpy_block(targets) for targets in (8, 4, 2))

    def _energy_block(y, gm, first, skip):
        q, v = y.reshape(2, -1, 3)
        total = 0.0
        for i in range(first + skip, first + LANES):
            potential = np.sum(gm[i + 1 :] / np.sqrt(np.sum((q[i + 1 :] - q[i]) ** 2, axis=1)))
            total += gm[i] * (0.5 * (v[i] @ v[i]) - potential)
        return total


_jit = cached_njit(error_model="numpy", _nrt=False)
_jit_allocating = cached_njit(error_model="numpy")


@_jit
def _accelerations_of_few(q, gm, out):
    n = gm.size
    for i in range(3 * n):
        out[i] = 0.0
    for i in range(n):
        x, y, z = q[3 * i], q[3 * i + 1], q[3 * i + 2]
        ax = ay = az = 0.0
        for j in range(i + 1, n):
            dx, dy, dz = q[3 * j] - x, q[3 * j + 1] - y, q[3 * j + 2] - z
            r2 = dx * dx + dy * dy + dz * dz
            w = 1.0 / (r2 * sqrt(r2))
            wi, wj = w * gm[j], w * gm[i]
            ax += wi * dx
            ay += wi * dy
            az += wi * dz
            out[3 * j] -= wj * dx
            out[3 * j + 1] -= wj * dy
            out[3 * j + 2] -= wj * dz
        out[3 * i] += ax
        out[3 * i + 1] += ay
        out[3 * i + 2] += az


@_jit
def _accelerations(q, gm, out):
    """out (3 N,) = sum over the other bodies of gm_j (q_j - q_i) / r^3."""
    n = gm.size
    if n < 4:
        _accelerations_of_few(q, gm, out)
    elif n < 8:
        _accelerations_4(q, gm, out, 0)
        _accelerations_4(q, gm, out, n - 4)
    else:
        rest = n % 8
        for k in range(n // 8 + (rest > 4)):
            _accelerations_8(q, gm, out, min(8 * k, n - 8))
        if 2 < rest <= 4:
            _accelerations_4(q, gm, out, n - 4)
        elif 0 < rest <= 2:
            _accelerations_2(q, gm, out, n - 2)


@intrinsic  # emits LLVM
def _inverse_roots(typingctx, x):
    """What `over_cube` shares between the two bodies of a pair: y and y^2 for y near x^-1/2, h, and 3/2 + 15/8 h."""

    def codegen(context, builder, signature, arguments):
        lanes = _Lanes(builder)
        y = lanes.root_estimate(arguments[0])
        y2 = builder.fmul(y, y)
        h = lanes.fma(builder.fneg(arguments[0]), y2, _constant(1.0))
        p = lanes.fma(_constant(15 / 8), h, _constant(3 / 2))
        return context.make_tuple(builder, signature.return_type, (y, y2, h, p))

    return types.UniTuple(OCTET, 4)(OCTET), codegen


@intrinsic  # emits LLVM
def _over_distance(typingctx, x):
    def codegen(context, builder, signature, arguments):
        return _Lanes(builder).over_distance(arguments[0])

    return OCTET(OCTET), codegen


@_jit
def _pull(gm, y, y2, h, p):
    """The quotient gm / x^(3/2) from `_inverse_roots`."""
    w = gm * y * y2
    return multiply_add(w * h, p, w)


@_jit
def _difference(q, i, j):
    """From body i to body j, and its square."""
    dx, dy, dz = q[3 * j] - q[3 * i], q[3 * j + 1] - q[3 * i + 1], q[3 * j + 2] - q[3 * i + 2]
    return dx, dy, dz, multiply_add(dz, dz, multiply_add(dy, dy, dx * dx))


@_jit
def _streams(n):
    """First of the bodies whose sources `_accelerations` takes in streams, and the number of streams."""
    rest = n % 8
    if n < 8:
        return 0, 2
    if 2 < rest <= 4:
        return n - 4, 2
    if 0 < rest <= 2:
        return n - 2, 4
    return n, 1


@_jit
def _add_pull(w, dx, dy, dz, out, k):
    out[k] = multiply_add(w, dx, out[k])
    out[k + 1] = multiply_add(w, dy, out[k + 1])
    out[k + 2] = multiply_add(w, dz, out[k + 2])


@_jit
def _accelerations_of_members(q, gm, out):
    """The same for octets: every pair once, sums in the same order.

    Bodies that `_accelerations` leaves to its last block get their sums in streams: those of body i stand in `sums`
    from 3 streams (i - in_streams) on.
    """
    n = gm.size
    in_streams, streams = _streams(n)
    start = n % streams
    sums = on_stack(MOST_SUMS)
    for k in range(3 * n):
        out[k] = 0.0
    for k in range(3 * streams * (n - in_streams)):
        sums[k] = 0.0
    for i in range(n):
        of_i = 3 * (i if i < start else (i - start) % streams)
        ax, ay, az = out[3 * i], out[3 * i + 1], out[3 * i + 2]
        for j in range(i + 1, n):
            dx, dy, dz, r2 = _difference(q, i, j)
            y, y2, h, p = _inverse_roots(r2)
            w = _pull(gm[j], y, y2, h, p)
            if i < in_streams:
                ax, ay, az = multiply_add(w, dx, ax), multiply_add(w, dy, ay), multiply_add(w, dz, az)
            else:
                of_j = 3 * (j if j < start else (j - start) % streams)
                _add_pull(w, dx, dy, dz, sums, 3 * streams * (i - in_streams) + of_j)
            w = -_pull(gm[i], y, y2, h, p)
            if j < in_streams:
                _add_pull(w, dx, dy, dz, out, 3 * j)
            else:
                _add_pull(w, dx, dy, dz, sums, 3 * streams * (j - in_streams) + of_i)
        out[3 * i], out[3 * i + 1], out[3 * i + 2] = ax, ay, az
    for i in range(in_streams, n):
        first = 3 * streams * (i - in_streams)
        for k in range(3):
            total = sums[first + k] + sums[first + k + 3]
            if streams == 4:
                halves = sums[first + k] + sums[first + k + 6], sums[first + k + 3] + sums[first + k + 9]
                total = halves[0] + halves[1]
            out[3 * i + k] = total


@intrinsic  # emits LLVM
def _accelerate(typingctx, q, gm, out):
    """`_accelerations` of one run, or of the members of an octet."""
    lanes = over_members(q)

    def one(q, gm, out):
        _accelerations(q, gm, out)

    def members(q, gm, out):
        if gm.size < 4:
            _accelerations_of_few(q, gm, out)
        else:
            _accelerations_of_members(q, gm, out)

    return in_octets(members if lanes else one, types.void, q, gm, out)


@_jit
def rhs(t, y, out, params):
    """The derivative (v, a) of the state (q, v); params holds every G m."""
    half = y.size // 2
    for i in range(half):
        out[i] = y[half + i]
    _accelerate(y[:half], params, out[half:])


@_jit_allocating
def acc(t, q, params):
    """The accelerations at the positions q."""
    out = np.empty(q.size)
    _accelerations(q, params, out)
    return out


@_jit
def _energy_of_few(y, gm):
    n, half = gm.size, y.size // 2
    kinetic = potential = 0.0
    for i in range(n):
        vx, vy, vz = y[half + 3 * i], y[half + 3 * i + 1], y[half + 3 * i + 2]
        kinetic += gm[i] * (vx * vx + vy * vy + vz * vz)
        partial = 0.0
        for j in range(i + 1, n):
            dx, dy, dz = y[3 * j] - y[3 * i], y[3 * j + 1] - y[3 * i + 1], y[3 * j + 2] - y[3 * i + 2]
            partial += gm[j] / sqrt(dx * dx + dy * dy + dz * dz)
        potential += gm[i] * partial
    return 0.5 * kinetic - potential


@_jit
def _energy_of_many(y, params):
    n = params.size
    total = 0.0
    for first in range(0, n - 7, 8):
        total += _energy_block(y, params, first, 0)
    if n % 8 > 0:
        total += _energy_block(y, params, n - 8, 8 - n % 8)
    return total


@_jit
def _carried_product(a, b, total, carry):
    new = multiply_add(a, b, total)
    return new, carry + multiply_add(a, b, total - new)


@_jit
def _carried_sum(a, b):
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


@_jit
def _energy_of_body(y, gm, i):
    """Energy of body i with the pairs that it makes with later ones, and its carry."""
    half = y.size // 2
    potential = potential_carry = square = carry = spread(0.0)
    for j in range(i + 1, gm.size):
        _, _, _, r2 = _difference(y, i, j)
        potential, potential_carry = _carried_product(gm[j], _over_distance(r2), potential, potential_carry)
    for k in range(half + 3 * i, half + 3 * i + 3):
        square, carry = _carried_product(y[k], y[k], square, carry)
    energy, lost = _carried_sum(0.5 * square, -potential)
    carry = lost + (0.5 * carry - potential_carry)
    total, lost = _carried_product(gm[i], energy, spread(0.0), spread(0.0))
    return total, multiply_add(gm[i], carry, lost)


@_jit
def _energy_of_eight(y, gm, first, skip):
    """The sum over the bodies first + skip ... first + 7, by halves."""
    a = _energy_of_four(y, gm, first, skip, 0)
    b = _energy_of_four(y, gm, first, skip, 1)
    total, lost = _carried_sum(a[0], b[0])
    return total + ((a[1] + b[1]) + lost)


@_jit
def _energy_of_four(y, gm, first, skip, k):
    """Bodies k, k + 4, k + 2 and k + 6 of a block of eight."""
    a, b = _energy_of_two(y, gm, first, skip, k), _energy_of_two(y, gm, first, skip, k + 2)
    total, lost = _carried_sum(a[0], b[0])
    return total, (a[1] + b[1]) + lost


@_jit
def _energy_of_two(y, gm, first, skip, k):
    a = b = spread(0.0), spread(0.0)
    if k >= skip:
        a = _energy_of_body(y, gm, first + k)
    if k + 4 >= skip:
        b = _energy_of_body(y, gm, first + k + 4)
    total, lost = _carried_sum(a[0], b[0])
    return total, (a[1] + b[1]) + lost


@_jit
def _energy_of_members(y, gm):
    n = gm.size
    total = spread(0.0)
    for first in range(0, n - 7, 8):
        total += _energy_of_eight(y, gm, first, 0)
    if n % 8 > 0:
        total += _energy_of_eight(y, gm, n - 8, 8 - n % 8)
    return total


@intrinsic  # emits LLVM
def _energy(typingctx, y, gm):
    """The energy of one run, or of the members of an octet."""
    if over_members(y):
        return in_octets(lambda y, gm: _energy_of_members(y, gm), OCTET, y, gm)
    return in_octets(lambda y, gm: _energy_of_many(y, gm), types.float64, y, gm)


if config.DISABLE_JIT:
    _accelerate, _energy = _accelerations, _energy_of_many


@_jit
def energy(t, y, params):
    """G times the energy."""
    if params.size < 8:
        return _energy_of_few(y, params)
    return _energy(y, params)


@_jit
def energy_gradient(t, y, f, out, params):
    """out (6 N,) from the derivative f of the state."""
    half = y.size // 2
    for i in range(half):
        gm = params[i // 3]
        out[i] = -gm * f[half + i]
        out[half + i] = gm * y[half + i]


@_jit_allocating
def momentum(t, y, params):
    """G times the angular momentum, three numbers: an array would be allocated at every call."""
    half = y.size // 2
    lx = ly = lz = 0.0
    for i in range(params.size):
        qx, qy, qz = y[3 * i], y[3 * i + 1], y[3 * i + 2]
        vx, vy, vz = y[half + 3 * i], y[half + 3 * i + 1], y[half + 3 * i + 2]
        gm = params[i]
        lx += gm * (qy * vz - qz * vy)
        ly += gm * (qz * vx - qx * vz)
        lz += gm * (qx * vy - qy * vx)
    return lx, ly, lz


@_jit
def momentum_gradient(t, y, out, params):
    """out (3, 6 N): row c holds the component c of d(q x v), +-gm times the other two components of v and q."""
    half = y.size // 2
    for i in range(params.size):
        gm, a = params[i], 3 * i
        b = half + a
        px, py, pz = gm * y[b], gm * y[b + 1], gm * y[b + 2]
        qx, qy, qz = gm * y[a], gm * y[a + 1], gm * y[a + 2]
        out[0, a], out[0, a + 1], out[0, a + 2] = 0.0, pz, -py
        out[1, a], out[1, a + 1], out[1, a + 2] = -pz, 0.0, px
        out[2, a], out[2, a + 1], out[2, a + 2] = py, -px, 0.0
        out[0, b], out[0, b + 1], out[0, b + 2] = 0.0, -qz, qy
        out[1, b], out[1, b + 1], out[1, b + 2] = qz, 0.0, -qx
        out[2, b], out[2, b + 1], out[2, b + 2] = -qy, qx, 0.0
