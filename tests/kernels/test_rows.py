"""Programs of operations along rows, against a slow reference in double precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from threading import get_ident

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import noise
from steps import explicit_transform

from blocksar.arrays import ComplexArray
from blocksar.kernels import groups, interpolation, rows
from blocksar.kernels.fourier import Axis, centred, dual
from blocksar.kernels.operations import Blend, Cut, Operation, Resample, ScaledTurn, Stretch, Transform, Turn, Window
from blocksar.kernels.phase import Phase
from blocksar.kernels.rows import Layout, Program

ROUNDING = 5e-7  # of complex64 through a transform, relative to the scale of the largest sample


def error(found: ComplexArray, wanted: np.ndarray) -> float:
    """Largest difference, relative to the root mean square of the expected values."""
    return float(np.abs(found - wanted).max() / np.sqrt(np.mean(np.abs(wanted) ** 2)))


def pair(n: int, size: int, *, step: float, start: float, dual_start: float) -> tuple[Axis, Axis]:
    return Axis(start, step, n), Axis(dual_start, 1 / (size * step), size)


def phasor(cycles: np.ndarray) -> np.ndarray:
    return np.exp(2j * np.pi * (cycles - np.rint(cycles)))


def resampled(row: np.ndarray, position: np.ndarray, n_tap: int, occupancy: float) -> np.ndarray:
    """Resample a row at any positions by least-squares weights of the nearest samples; zeros beyond the ends."""
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    gram = np.sinc(occupancy * (k[:, None] - k)) + 1e-9 * np.eye(n_tap)
    whole = np.floor(position).astype(int)
    weights = np.linalg.solve(gram, np.sinc(occupancy * (position - whole - k[:, None])))
    padded = np.pad(row, 1000)
    return np.sum(weights * padded[np.clip(whole + k[:, None] + 1000, 0, padded.size - 1)], axis=0)


def slowly(
    operations: Sequence[Operation], x: np.ndarray, axis: Axis, *, n_tap: int = 0, occupancy: float = 0.0
) -> np.ndarray:
    """Apply the operations one after the other, in complex128."""
    x = x.astype(np.complex128)
    for operation in operations:
        match operation:
            case Turn():
                x = x * phasor(operation.phase.cycles(axis.values))
            case ScaledTurn():
                x = x * phasor(np.multiply.outer(operation.factor, operation.cycles))
            case Transform():
                x = explicit_transform(
                    x, operation.source, operation.target, inverse=operation.inverse, period=operation.period
                )
                axis = operation.target
            case Window():
                x = x * operation.values[operation.which]
            case Stretch():
                at = operation.middle + (np.arange(axis.size) - operation.middle) * operation.scale[:, None]
                x = np.array([resampled(row, place, n_tap, occupancy) for row, place in zip(x, at, strict=True)])
                x *= operation.scale[:, None]
            case Resample():
                u = (np.arange(axis.size) - axis.size // 2) / (axis.size / 2)
                curves = [np.polynomial.Polynomial(c) for c in operation.positions]
                x = np.array([resampled(row, c(u), n_tap, occupancy) for row, c in zip(x, curves, strict=True)])
                x *= np.sqrt([c.deriv()(u) / (axis.size / 2) for c in curves])
    return x


# -- one transform ------------------------------------------------------------------------------------------

SIZES = [(1, 1), (1, 5), (7, 7), (12, 15), (13, 20), (64, 64), (101, 128)]
STARTS = [(0.0, 0.0), (-0.4137, 3977.77), (123.456, -9000.1)]


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("starts", STARTS)
@pytest.mark.parametrize("sizes", SIZES)
def test_a_transform_equals_its_sum(sizes: tuple[int, int], starts: tuple[float, float], inverse: bool) -> None:
    source, target = pair(*sizes, step=1.25e-4, start=starts[0], dual_start=starts[1])
    x = noise(5, source.size)
    wanted = explicit_transform(x, source, target, inverse=inverse, period=target.size)
    found = rows.transform(x, source, target, inverse=inverse)
    assert found.dtype == np.complex64
    assert error(found, wanted) < 4 * ROUNDING


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 60),
    padding=st.integers(0, 40),
    step=st.floats(1e-5, 1e5),
    start=st.floats(-50, 50),
    dual_start=st.floats(-50, 50),
)
def test_a_transform_and_its_inverse_are_the_identity(
    n: int, padding: int, step: float, start: float, dual_start: float
) -> None:
    """Axes start at any fraction of a sample; the padding returns as zeros."""
    size = n + padding
    time, doppler = pair(n, size, step=step, start=start * step, dual_start=dual_start / (size * step))
    x = noise(3, n)
    long = Axis(time.start, time.step, size)
    back = rows.to_time(rows.to_doppler(x, time, doppler), doppler, long)
    scale = np.abs(x).max()
    assert np.abs(back[:, :n] - x).max() < 4 * ROUNDING * scale
    assert np.abs(back[:, n:]).max(initial=0.0) < 4 * ROUNDING * scale


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize(
    ("n", "period", "kept", "n_column"),
    [(1, 1, 1, 1), (9, 9, 9, 33), (12, 15, 4, 5), (13, 40, 40, 32), (80, 108, 61, 77)],
)
def test_a_transform_of_columns_is_padded_and_cut(n: int, period: int, kept: int, n_column: int, inverse: bool) -> None:
    source = Axis(-3.3e6, 0.625e6, n)
    target = Axis(-7.7e-7, 1 / (period * source.step), kept)
    x = noise(n, n_column)
    wanted = explicit_transform(x.T, source, target, inverse=inverse, period=period).T
    program = Program([Transform(source, target, inverse)], source=source, n_row=n_column)
    assert program.transforms == [period]
    found = program.run(x, load="columns", store="columns")
    assert found.shape == (kept, n_column)
    assert error(found, wanted) < 4 * ROUNDING


@pytest.mark.parametrize("size", [9, 16, 29])
def test_samples_beyond_the_period_are_those_of_the_sum(size: int) -> None:
    """Ranges of a narrow range window go on beyond it, into which the interpolation reaches."""
    x, source, target = noise(3, 8), Axis(-3.4, 0.5, 8), Axis(0.7, 0.25, size)
    found = rows.transform(x, source, target, inverse=True)
    kernel = np.exp(2j * np.pi * np.outer(source.values, target.values)) / 8
    assert error(found, x @ kernel) < 4 * ROUNDING


# -- programs -----------------------------------------------------------------------------------------------

TAPS, OCCUPANCY = 24, 0.6  # these err by less than 1e-6, their expansion about a few fractions by 1e-5
STRETCHED = 4e-5


def resampling(n_row: int, n: int) -> Resample:
    """Resampling about the middle of the row, at 0.9 to 1.1 samples per sample."""
    bend = np.random.default_rng(n).uniform(-0.02, 0.02, (n_row, 3)) / [2, 3, 4]
    positions = n / 2 * np.column_stack([np.full(n_row, 1.0), np.full(n_row, 1.01), bend])
    return Resample(positions, interpolation.tap_polynomials(TAPS, occupancy=OCCUPANCY))


def long_program(n_row: int) -> tuple[list[Operation], Axis, Axis]:
    """A program with every kind of operation; only the spectrum between the transforms is resampled."""
    rng = np.random.default_rng(n_row)
    time = centred(0.3, 1e-3, 150)
    doppler = dual(time, size=256, centre=55.0)
    long = centred(0.28, 1e-3, 256)
    wide = dual(long, size=320, centre=-20.0)
    # A window over half the band, zero at both ends: the signal fades out there, and a stretch cuts nothing off.
    away = np.abs(np.arange(256) - 128) / 60
    edge = np.where(away < 1, np.cos(np.pi / 2 * away) ** 4, 0)
    windows = (edge * np.array([[1.0], [0.7]])).astype(np.complex64)
    operations: list[Operation] = [
        Turn(Phase(rng.uniform(-3, 3, (1, 4)), centre=0.3, scale=0.1)),
        Turn(Phase(rng.uniform(-3, 3, (n_row, 3)), centre=0.2, scale=0.2)),
        Transform(time, doppler, inverse=False),
        Turn(Phase(rng.uniform(-3, 3, (n_row, 2)), centre=0.0, scale=500.0)),
        ScaledTurn(rng.uniform(0.9, 1.1, n_row), 2 * np.cos(np.arange(256) / 40)),
        Window(windows, rng.integers(0, 2, n_row)),
        Turn(Phase(rng.uniform(-1, 1, (n_row, 2)), centre=50.0, scale=500.0)),
        Transform(doppler, long, inverse=True),
        Stretch(rng.uniform(0.98, 1.02, n_row), 120.0, interpolation.tap_polynomials(TAPS, occupancy=OCCUPANCY)),
        resampling(n_row, 256),
        Turn(Phase(rng.uniform(-9, 9, (n_row, 10)), centre=0.28, scale=0.2)),
        Turn(Phase(rng.uniform(-1e5, 1e5, (1, 1)), centre=0.0, scale=1.0)),
        Transform(long, wide, inverse=False),
    ]
    return operations, time, wide


@pytest.mark.parametrize("cut", range(14))
def test_a_program_may_end_after_any_operation(cut: int) -> None:
    """Operations deferred to the next copy are applied at the end, whatever the last operation."""
    operations, time, _ = long_program(5)
    operations = operations[:cut]
    x = noise(5, time.size) * np.hanning(time.size).astype(np.float32)
    program = Program(operations, source=time, n_row=5)
    assert program.transforms == [256, 256, 320][: sum(isinstance(each, Transform) for each in operations)]
    found = program.run(x)
    wanted = slowly(operations, x, time, n_tap=TAPS, occupancy=OCCUPANCY)
    assert error(found, wanted) < (STRETCHED if cut > 8 else 12 * ROUNDING)
    stored = Program(operations, source=time, n_row=5).run(x.T.copy(), load="columns", store="columns")
    np.testing.assert_array_equal(stored, found.T)


def test_a_program_may_begin_with_a_window_a_stretch_or_a_curve() -> None:
    axis = Axis(0.0, 1.0, 200)
    x = noise(6, 200) * np.hanning(200).astype(np.float32)
    spectrum = np.fft.fft(x, axis=1)
    spectrum[:, 50:-50] = 0
    x = np.fft.ifft(spectrum, axis=1).astype(np.complex64)
    given = x.copy()
    window = Window(noise(2, 200), np.array([0, 1, 1, 0, 1, 0]))
    stretch = Stretch(np.linspace(0.99, 1.01, 6), 100.0, interpolation.tap_polynomials(TAPS, occupancy=OCCUPANCY))
    curve = resampling(6, 200)
    pairs: list[list[Operation]] = [[stretch, window], [window, window], [stretch, stretch], [curve, stretch]]
    for operations in ([window], [stretch], [curve], *pairs):
        found = Program(operations, source=axis, n_row=6).run(x)
        wanted = slowly(operations, x, axis, n_tap=TAPS, occupancy=OCCUPANCY)
        # Near its ends the row is no longer band-limited, and any set of weights errs.
        inner = slice(30, -30)
        tolerance = 4 * ROUNDING if {*operations} == {window} else STRETCHED
        assert error(found[:, inner], wanted[:, inner]) < tolerance
        np.testing.assert_array_equal(x, given)


@pytest.mark.parametrize("layout", ["rows", "columns"])
def test_a_cut_keeps_samples_modulo_the_length_of_the_row(layout: Layout) -> None:
    """Also after a phase, which is held back otherwise, and before one that is different in each row."""
    axis, kept = Axis(0.0, 1.0, 40), Axis(-7.0, 1.0, 25)
    first = np.array([0, 15, 16, 39, -7, -40, 4023])
    before, after = Phase(np.array([[0.1, 0.02]]), 0.0, 1.0), Phase(0.01 * np.arange(14.0).reshape(7, 2), 0.0, 1.0)
    x = noise(7, 40)
    turned = x * np.exp(2j * np.pi * before.cycles(axis.values))
    wanted = np.stack([np.roll(row, -begin)[:25] for row, begin in zip(turned, first, strict=True)])
    wanted = wanted * np.exp(2j * np.pi * after.cycles(kept.values))
    program = Program([Turn(before), Cut(first, kept), Turn(after)], source=axis, n_row=7)
    assert program.target == kept
    given = x if layout == "rows" else x.T.copy()
    assert error(program.run(given, load=layout), wanted) < ROUNDING * 4
    bare = Program([Cut(first, kept)], source=axis, n_row=7).run(given, load=layout)
    np.testing.assert_array_equal(bare, [np.roll(row, -begin)[:25] for row, begin in zip(x, first, strict=True)])


def test_phases_that_do_not_fit_into_one_pass_take_several() -> None:
    axis = Axis(-0.5, 1 / 64, 64)
    scaled = ScaledTurn(np.array([0.7, -1.3]), np.cos(np.arange(64) / 5))
    other = ScaledTurn(np.array([0.2, 2.0]), np.sin(np.arange(64) / 7))
    curved = Turn(Phase(np.array([[0.1, 2.0, 3.0]]), 0.0, 1.0))
    cycles = {
        id(scaled): np.outer(scaled.factor, scaled.cycles),
        id(other): np.outer(other.factor, other.cycles),
        id(curved): 0.1 + 2 * axis.values + 3 * axis.values**2,
    }
    x = noise(2, 64)
    for operations in ([scaled, other], [scaled, curved], [curved, scaled], [other, curved, scaled, other]):
        wanted = x * np.exp(2j * np.pi * sum(cycles[id(operation)] for operation in operations))
        assert error(Program(operations, source=axis, n_row=2).run(x), wanted) < 4 * ROUNDING


# -- Layouts of the input and the output --------------------------------------------------------------------

N_ROW, LENGTH, PERIOD, KEPT = 117, 900, 1000, 950


def turned_transform(*, inverse: bool = False) -> Program:
    source, target = pair(LENGTH, PERIOD, step=0.01, start=-2.0, dual_start=-40.0)
    rate = np.random.default_rng(3).uniform(-9, 9, (N_ROW, 3))
    operations = [
        Turn(Phase(rate, 2.0, 5.0)),
        Transform(source, target.part(0, KEPT), inverse),
        Turn(Phase(rate, 0, 50.0)),
    ]
    return Program(operations, source=source, n_row=N_ROW)


@pytest.mark.parametrize("store", ["rows", "columns"])
@pytest.mark.parametrize("load", ["rows", "columns"])
def test_rows_are_read_from_and_stored_as_rows_or_columns(load: Layout, store: Layout) -> None:
    program, x = turned_transform(), noise(N_ROW, LENGTH)
    assert len(program.groups(0, N_ROW, columns=load == "columns")) > 1
    assert N_ROW % program.groups(0, N_ROW, columns=True)[0].stop
    given = x if load == "rows" else np.ascontiguousarray(x.T)
    given.flags.writeable = False
    found = program.run(given, load=load, store=store)
    found = found if store == "rows" else found.T
    assert found.shape == (N_ROW, KEPT)
    assert error(found, program.run(x)) < 4 * ROUNDING
    # Read through a stride and written into an existing array: the same bits.
    spread = np.repeat(given, 2, axis=1)[:, ::2] if load == "columns" else given
    out = np.empty((N_ROW, KEPT) if store == "rows" else (KEPT, N_ROW), np.complex64)
    again = program.run(spread, out=out, load=load, store=store)
    assert again is out
    np.testing.assert_array_equal(out if store == "rows" else out.T, found)


@pytest.mark.parametrize("store", ["rows", "columns"])
@pytest.mark.parametrize("load", ["rows", "columns"])
def test_a_program_run_on_some_rows_gives_those_rows_of_its_result(load: Layout, store: Layout) -> None:
    program, x = turned_transform(), noise(N_ROW, LENGTH)
    whole = program.run(x)
    first, last = 37, 110
    given = x[first:last] if load == "rows" else np.ascontiguousarray(x[first:last].T)
    part = program.run(given, first=first, load=load, store=store)
    part = part if store == "rows" else part.T
    assert part.shape == (last - first, KEPT)
    assert error(part, whole[first:last]) < 4 * ROUNDING
    out = np.full((N_ROW, KEPT) if store == "rows" else (KEPT, N_ROW), 7, np.complex64)
    program.run(given, out=out, first=first, load=load, store=store, threads=2)
    written = out if store == "rows" else out.T
    np.testing.assert_array_equal(written[first:last], part)
    assert (written[:first] == 7).all() and (written[last:] == 7).all()

    # From the start of a group on, the result is the same to the bit.
    second = program.groups(0, N_ROW, columns=False)[1]
    np.testing.assert_array_equal(program.run(x[second], first=second.start), whole[second])


@pytest.mark.parametrize("layout", ["rows", "columns"])
def test_a_resampled_row_has_the_same_bits_in_any_group_and_on_any_thread(layout: Layout) -> None:
    program, x = Program([resampling(N_ROW, LENGTH)], source=Axis(0.0, 1.0, LENGTH), n_row=N_ROW), noise(N_ROW, LENGTH)
    whole = program.run(x)
    assert len(program.groups(0, N_ROW, columns=layout == "columns")) > 1
    for first, last, threads in ((0, N_ROW, 2), (0, N_ROW, 3), (1, 2, 1), (37, 110, 3)):
        given = x[first:last] if layout == "rows" else np.ascontiguousarray(x[first:last].T)
        found = program.run(given, first=first, load=layout, store=layout, threads=threads)
        np.testing.assert_array_equal(found if layout == "rows" else found.T, whole[first:last])


@pytest.mark.parametrize("sizes", [(30, 40, 40), (40, 40, 25), (17, 40, 23)])
def test_columns_may_be_overwritten_in_place(sizes: tuple[int, int, int]) -> None:
    """Input and output columns share one buffer, although one may be shorter than the other."""
    n, period, kept = sizes
    source, target = pair(n, period, step=0.1, start=-1.0, dual_start=3.0)
    n_column = 77
    turn = Turn(Phase(np.random.default_rng(n).uniform(-3, 3, (n_column, 4)), 0.0, 2.0))
    program = Program([turn, Transform(source, target.part(0, kept), True)], source=source, n_row=n_column)
    x = noise(n, n_column)
    wanted = program.run(x, load="columns", store="columns")
    for threads in (1, 3):
        buffer = np.zeros((max(n, kept), n_column), np.complex64)
        buffer[:n] = x
        found = program.run(buffer[:n], out=buffer[:kept], load="columns", store="columns", threads=threads)
        np.testing.assert_array_equal(found, wanted)
        np.testing.assert_array_equal(buffer[:kept], wanted)


@pytest.mark.parametrize("inverse", [False, True])
def test_the_number_of_threads_changes_no_bit(inverse: bool) -> None:
    program = turned_transform(inverse=inverse)
    x = noise(N_ROW, LENGTH)
    columns = np.ascontiguousarray(x.T)
    one, one_column = program.run(x), program.run(columns, load="columns", store="columns")
    for threads in (2, 3, 7):
        np.testing.assert_array_equal(program.run(x, threads=threads), one)
        again = program.run(columns, load="columns", store="columns", threads=threads)
        np.testing.assert_array_equal(again, one_column)

    operations, time, _ = long_program(700)
    program, x = Program(operations, source=time, n_row=700), noise(700, time.size)
    assert len(program.groups(0, 700, columns=False)) > 1
    np.testing.assert_array_equal(program.run(x, threads=3), program.run(x))


# -- Groups -------------------------------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(first=st.integers(0, 50), count=st.integers(0, 3000), length=st.integers(1, 300_000), columns=st.booleans())
def test_groups_cover_each_row_once(first: int, count: int, length: int, columns: bool) -> None:
    some = groups.row_groups(first, first + count, length, columns=columns)
    assert [i for group in some for i in range(group.start, group.stop)] == list(range(first, first + count))
    multiple = 2 * groups.GROUP_ROWS if columns else groups.GROUP_ROWS
    sizes = [group.stop - group.start for group in some]
    assert all(size % multiple == 0 for size in sizes[:-1])
    assert len(set(sizes[:-1])) <= 1
    assert all(size <= max(groups.GROUP_BYTES / (8 * length), multiple) for size in sizes)
    assert all(one.stop == next_one.start for one, next_one in pairwise(some))


def test_windows_are_computed_once_for_all_threads() -> None:
    asked = []

    def windows() -> ComplexArray:
        asked.append(get_ident())
        return np.ones((1, 4096), np.complex64)

    which, axis = np.zeros(512, np.int64), Axis(0.0, 1.0, 4096)
    program = Program([Window(windows, which)], source=axis, n_row=512)
    assert not asked and len(program.groups(0, 512, columns=False)) > 8
    x = np.ones((512, 4096), np.complex64)
    for _ in range(2):
        np.testing.assert_array_equal(program.run(x, threads=4), x)
    assert len(asked) == 1


@pytest.mark.parametrize("threads", [1, 4])
def test_a_failure_in_a_group_is_raised(threads: int) -> None:
    done: list[int] = []

    def work(group: slice) -> None:
        if group.start == 2:
            raise ZeroDivisionError
        done.append(group.start)

    with pytest.raises(ZeroDivisionError):
        groups.run_groups(work, [slice(i, i + 1) for i in range(4)], threads)
    done.clear()
    groups.run_groups(work, [slice(i, i + 1) for i in range(3, 9)], threads)
    assert sorted(done) == list(range(3, 9))


@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_blend_is_a_sum_of_windowed_transforms(count: int, alike: bool) -> None:
    """Lagrange's polynomials through equal steps of 0 .. 1 share out the transforms along the target axis.

    The rows fit into one group, whose mean share they take if theirs are alike.
    """
    n_row, n = 7, 96
    rng = np.random.default_rng(count)
    time = centred(0.1, 1e-3, n)
    doppler = dual(time, size=n, centre=40.0)
    windows = (rng.uniform(0, 1, (2, count, n)) + 1j * rng.uniform(0, 1, (2, count, n))).astype(np.complex64)
    blend = Blend(
        transform=Transform(time, doppler, inverse=False),
        windows=lambda: windows,
        count=count,
        which=rng.integers(0, 2, n_row),
        share=np.array([0.5, 0.3, -0.1]) * rng.uniform(0.997 if alike else 0.5, 1, (n_row, 1)),
        centre=30.0,
        scale=500.0,
    )
    x = noise(n_row, n)
    z = (doppler.values - blend.centre) / blend.scale
    share = np.polynomial.polynomial.polyval(z, (blend.share.mean(axis=0) if alike else blend.share).T)
    nodes = np.linspace(0, 1, count) if count > 1 else np.zeros(1)
    wanted = np.zeros((n_row, n), np.complex128)
    for k in range(count):
        part = explicit_transform(x * windows[blend.which, k], time, doppler, inverse=False, period=n)
        for other in np.delete(nodes, k):
            part = part * (share - other) / (nodes[k] - other)
        wanted += part
    program = Program([Turn(Phase(np.zeros((1, 2)), 0.0, 1.0)), blend], source=time, n_row=n_row)
    found = program.run(x)
    assert np.abs(found - wanted).max() < 1e-5 * np.abs(wanted).max()
    assert program.transforms == [n] * count
    padded = Transform(time, dual(time, size=2 * n, centre=0.0), inverse=False)
    with pytest.raises(ValueError, match="without padding only"):
        Program([replace(blend, transform=padded)], source=time, n_row=n_row)
