"""Recordings of a random excitation -> FRF matrix: H1, H2, Hv from Welch's averages, with coherence and
covariance.

Frequency is axis 0. S_uu (n_frequency, n_input, n_input), S_yu = E[Y U*] (n_frequency, n_output, n_input),
S_yy (n_frequency, n_output, n_output); the result is (n_frequency, n_output, n_input).

Every estimator solves E[(y_o - H_o u) z_o^H] = 0 for its own instruments z_o = W_o [u; y]: INSTRUMENTS gives
W (n_frequency, n_output, n_input, n_input + n_output) from the response and the power of all channels, forces
first (n_frequency, n_input + n_output); n_output is 1 where all outputs share them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, freeze_bases
from labpipe.errors import ConfigError
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.records.response import BlockCovariance, Blocks, StoredCovariance
from labpipe.spectra import quality
from labpipe.spectra.bands import block_samples, line_range
from labpipe.spectra.channels import checked_blocks
from labpipe.spectra.covariance import (
    covariance_of_h1,
    covariance_of_random,
    lines_around,
    noise_levels,
    noise_shape,
    pooled_by_force,
    pooled_residual,
    residual_spectrum,
)
from labpipe.spectra.local import local_parts
from labpipe.spectra.matrices import at_lines, definite_inverse, hermitian, inverse, product, without_rounding
from labpipe.spectra.ports import Layout, Parts, at_columns, coherence_findings, select_lines
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.welch import CrossSpectra, WelchAverage
from labpipe.spectra.windows import window_values


def h1(
    s_uu: ComplexArray,
    s_yu: ComplexArray,
    s_yy: ComplexArray,  # noqa: ARG001 (one signature for the whole table)
) -> ComplexArray:
    """H1 = S_yu S_uu^-1, (n_frequency, n_output, n_input) [output unit / N]: unbiased by noise on the
    outputs. Spectra as in the module's docstring [unit^2/Hz]. Raises numpy.linalg.LinAlgError for a singular
    S_uu. Equation (frf-h1).
    """
    return product(s_yu, definite_inverse(s_uu)[0])


def h2(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> ComplexArray:  # noqa: ARG001
    """H2 = S_yy S_uy^-1, (n_frequency, n_output, n_input) [output unit / N]: unbiased by noise on the forces.
    Spectra as in the module's docstring [unit^2/Hz]. ConfigError unless there are as many outputs as forces;
    numpy.linalg.LinAlgError for a singular S_uy. Equation (frf-h2).
    """
    if s_yu.shape[1] != s_yu.shape[2]:
        raise ConfigError("H2 needs as many responses as forces", hint="use H1 or Hv")
    return product(s_yy, inverse(hermitian(s_yu)))


def hv(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> ComplexArray:
    """Hv, total least squares per output, (n_frequency, n_output, n_input) [output unit / N]: noise on forces
    and output alike. Spectra as in the module's docstring [unit^2/Hz]. Each channel is first divided by its
    own power at the line, so that the result does not depend on units. Equation (frf-hv).
    """
    n_input = s_uu.shape[1]
    force_scale = np.sqrt(np.einsum("fii->fi", s_uu).real)
    columns = []
    for output in range(s_yu.shape[1]):
        response_scale = np.sqrt(s_yy[:, output, output].real)[:, None]
        scale = np.concatenate([force_scale, response_scale], axis=1)
        joint = np.empty((s_uu.shape[0], n_input + 1, n_input + 1), np.complex128)
        joint[:, :n_input, :n_input] = s_uu
        joint[:, n_input:, :n_input] = s_yu[:, output : output + 1]
        joint[:, :n_input, n_input:] = hermitian(joint[:, n_input:, :n_input])
        joint[:, n_input, n_input] = s_yy[:, output, output]
        _, vectors = np.linalg.eigh(joint / (scale[:, :, None] * scale[:, None, :]))
        smallest = vectors[:, :, 0] / scale
        columns.append(-smallest[:, :n_input].conj() / smallest[:, n_input:].conj())
    return np.stack(columns, axis=1)


def _chosen_channels(response: ComplexArray, first: int) -> ComplexArray:
    """z = u or y, from the channel *first* on: W = [0 I 0] at every line and for every output."""
    n_frequency, n_output, n_input = response.shape
    chosen = np.eye(n_input, n_input + n_output, first, dtype=np.complex128)
    return np.broadcast_to(chosen, (n_frequency, 1, *chosen.shape))


def adjusted_forces_as_instruments(response: ComplexArray, power: FloatArray) -> ComplexArray:
    """z = the forces projected onto the plane y = H u in scaled channels, for Hv: W (n_frequency, n_output,
    n_input, n) [1].

    response (n_frequency, n_output, n_input) [output unit / N], power (n_frequency, n) [unit^2/Hz], n =
    n_input + n_output. With q the normal (-H, 1) of that plane in channels divided by their own power, z = (I
    - q q^H / q^H q) [u; y]. Equation (frf-hv-instruments).
    """
    n_frequency, n_output, n_input = response.shape
    scale = np.sqrt(power)
    weights = np.zeros((n_frequency, n_output, n_input, n_input + n_output), np.complex128)
    for output in range(n_output):
        columns = [*range(n_input), n_input + output]
        residual = np.concatenate([-response[:, output], np.ones((n_frequency, 1))], axis=1)
        normal = (residual * scale[:, columns]).conj()
        shift = normal[:, :n_input] * scale[:, :n_input] / np.sum(np.abs(normal) ** 2, axis=1)[:, None]
        weights[:, output, :, columns] = np.moveaxis(
            np.eye(n_input, n_input + 1) - shift[:, :, None] * residual[:, None, :], 2, 0
        )
    return weights


ESTIMATORS: dict[str, Callable[[ComplexArray, ComplexArray, ComplexArray], ComplexArray]] = {
    "H1": h1,
    "H2": h2,
    "Hv": hv,
}
INSTRUMENTS: dict[str, Callable[[ComplexArray, FloatArray], ComplexArray]] = {
    "H1": lambda response, _: _chosen_channels(response, 0),
    "H2": lambda response, _: _chosen_channels(response, response.shape[2]),
    "Hv": adjusted_forces_as_instruments,
}

# Variance of a fit with estimated weights over that with known ones, up to which every force keeps its own
# noise (Equation (est-weights)); least of the degrees of freedom of one over the most.
MOST_LOST, LEAST_SHARE = 2.0, 0.5
# Coherence of the noise of two responses above which they share it, as leakage of one force.
MOST_SHARED = 0.1
# A record of which the spectra of the whole and of its first half are known; None where that is too short. Of
# the half the columns of the forces may be all there is.
Halved = tuple[CrossSpectra, CrossSpectra | None]


def cut_at(blocks: Iterable[FloatArray], middle: int) -> Iterator[tuple[FloatArray, bool]]:
    """The *blocks* (n, n_channel) [any unit] in order, cut so that one ends before sample *middle*. True for
    that one.
    """
    start = 0
    for block in blocks:
        end = start + block.shape[0]
        if start < middle < end:
            yield block[: middle - start], True
            yield block[middle - start :], False
        else:
            yield block, end == middle
        start = end


def joined_spectra(spectra: Sequence[CrossSpectra], layout: Layout) -> ComplexArray:
    """Cross-spectra of all channels (n_line, n_channel, n_channel) [unit^2/Hz], recordings weighted by their
    numbers of blocks. Or (n_line, n_channel, n_input), where they are those of all channels with the forces
    that act in each recording.
    """
    if len(spectra) == 1:
        return _pad(layout, 0, spectra[0].matrix)
    joined: ComplexArray = np.sum(shares_of(spectra, layout), axis=0)
    return joined


def shares_of(spectra: Sequence[CrossSpectra], layout: Layout) -> list[ComplexArray]:
    """What each recording adds to joined_spectra, of the same shape [unit^2/Hz]."""
    n_block = sum(spectrum.n_block for spectrum in spectra)
    return [_pad(layout, e, s.matrix) * (s.n_block / n_block) for e, s in enumerate(spectra)]


def blocks_of(
    spectra: Sequence[CrossSpectra], settings: FrfSettings, estimator: str, derivatives: int = 0
) -> Blocks:
    """The blocks averaged to *spectra* by an *estimator*, *derivatives* as of the layout."""
    assert settings.block is not None
    number = sum(spectrum.n_block for spectrum in spectra)
    return Blocks(
        settings.block, settings.window, settings.overlap, number, estimator, derivatives=derivatives
    )


def _pad(layout: Layout, recording: int, matrix: ComplexArray) -> ComplexArray:
    """The *matrix* of all channels, or with the acting forces, in the layout's order; 0 for an absent one."""
    if matrix.shape[1] == matrix.shape[2]:
        return layout.pad(recording, matrix, 2)
    rows = layout.pad(recording, matrix.swapaxes(1, 2), 1).swapaxes(1, 2)
    acting = np.array(layout.input_columns[recording]) >= 0
    return at_columns(rows, np.where(acting, np.cumsum(acting) - 1, -1).tolist(), 1)


def change_of_random(
    halved: Sequence[Halved],
    layout: Layout,
    chosen: BoolArray,
    response_of: Callable[[ComplexArray], ComplexArray],
    least: float,
) -> ComplexArray | None:
    """H of the second half of all records less that of the first, (n_line, n_output, n_input) [output unit /
    N], at the *chosen* lines. *response_of*: H of the spectra (n_line, n_channel, n_channel) [unit^2/Hz] of
    the layout's channels. None where a half has no more than *least* averages, too few for the noise of an
    FRF of so many forces.
    """
    first = [half for _, half in halved if half is not None]
    if len(first) < len(halved) or min(half.averages for half in first) <= least:
        return None
    rest = [
        _rest(whole, half, layout.input_columns[number])
        for number, ((whole, _), half) in enumerate(zip(halved, first, strict=True))
    ]
    before, after = (response_of(at_lines(joined_spectra(half, layout), chosen)) for half in (first, rest))
    return after - before


def _rest(whole: CrossSpectra, half: CrossSpectra, forces: Sequence[int]) -> CrossSpectra:
    n_block = whole.n_block - half.n_block
    matrix = whole.matrix
    if half.matrix.shape[2] < matrix.shape[2]:
        matrix = matrix.transpose(1, 2, 0)[:, [column for column in forces if column >= 0]].transpose(2, 0, 1)
    rest = matrix * (whole.n_block / n_block)
    rest -= half.matrix * (half.n_block / n_block)
    return replace(whole, matrix=rest, n_block=n_block)


def random_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF from Welch averages of all recordings, or by local polynomials. DataError for recordings or
    forces that do not allow one.
    """
    if settings.local == "polynomial":
        return local_parts(sources, settings, layout)
    # The columns of the acting forces are all that H1 needs of a half.
    of_half = [
        [column for column in columns if column >= 0] if settings.estimator == "H1" else None
        for columns in layout.input_columns
    ]
    halved = [
        welch_average(source, settings, columns) for source, columns in zip(sources, of_half, strict=True)
    ]
    spectra = [whole for whole, _ in halved]
    blocks = blocks_of(spectra, settings, settings.estimator, layout.derivatives)
    single = settings.estimator == "H1" and layout.one_force_each
    apart = single and tells_noise_by_force(spectra, layout)
    if single:
        of_force = np.array([spectrum.n_block for spectrum in spectra]) @ _acting(layout)
        blocks = replace(blocks, by_force=tuple(map(int, of_force)), apart=apart)
    parts = parts_of_spectra(spectra, settings, layout, apart=apart)
    n_input, chosen = len(layout.inputs), select_lines(halved[0][0].frequency, settings)
    estimate = ESTIMATORS[settings.estimator]

    def response_of(s: ComplexArray) -> ComplexArray:
        return estimate(s[:, :n_input, :n_input], s[:, n_input:, :n_input], s[:, n_input:, n_input:])

    blocks = with_bursts(blocks, spectra, sources)
    # Of the places that blocks have in a burst where they overlap, no half has its even share.
    if not (blocks.bursts and blocks.overlap):
        parts = replace(parts, change=change_of_random(halved, layout, chosen, response_of, n_input + 1))
    return replace(parts, blocks=blocks)


# Parts of a block, share of the mean power below which one rests, share of a block that a burst leaves at
# least, longer than a slow force is near zero; and blocks that are looked at first.
PARTS, AT_REST, LEAST_REST, FIRST = 256, 0.01, 0.03, 8


def with_bursts(blocks: Blocks, spectra: Sequence[CrossSpectra], sources: Sequence[SampleSource]) -> Blocks:
    """The *blocks* of the *spectra* of *sources*, with the course of forces that rest in the same part of
    each.
    """
    for most in (FIRST, None):
        force = np.sum([_force_powers(source, blocks.length, most) for source in sources], axis=0)
        rests = force < AT_REST * np.mean(force)
        acts = np.flatnonzero(~rests)
        if np.max(np.diff(acts, append=acts[:1] + rests.size), initial=0) <= LEAST_REST * rests.size:
            return blocks
    # The mean that is taken off a block is no force. Blocks that overlap begin elsewhere in a burst.
    force[rests] = 0.0
    starts = np.arange(0, force.size, force.size * (1 - blocks.overlap))
    numbers = np.concatenate([np.arange(spectrum.n_block) for spectrum in spectra])
    n_block = np.bincount(numbers % starts.size, minlength=starts.size)
    course = n_block @ [np.roll(force, -round(start)) for start in starts.tolist()]
    return replace(blocks, bursts=tuple((course / np.mean(course)).tolist()))


def _force_powers(source: SampleSource, length: float, most: int | None) -> FloatArray:
    """Mean squares (n_part,) [N^2] of the forces, summed over the first *most* blocks."""
    n_sample, inputs = block_samples(source, length), [c.role == "input" for c in source.channels]
    edges = np.linspace(0, n_sample, min(PARTS, n_sample) + 1).astype(int)
    power, number = np.zeros(edges.size - 1), 0
    # A file's own blocks end where its parts do.
    rest: FloatArray = np.empty((0, sum(inputs)))
    for block in source.blocks(n_sample):
        rest = np.concatenate([rest, block[:, inputs]]) if len(rest) else block[:, inputs]
        if len(rest) >= n_sample:
            whole, rest, number = rest[:n_sample], rest[n_sample:], number + 1
            square = np.sum((whole - np.mean(whole, axis=0)) ** 2, axis=1)
            power += np.add.reduceat(square, edges[:-1]) / np.diff(edges)
            if number == most:
                break
    return power


def parts_of_spectra(
    spectra: Sequence[CrossSpectra],
    settings: FrfSettings,
    layout: Layout,
    shared: float = 0.0,
    apart: bool = False,
) -> Parts:
    """The FRF from the averaged spectra of every recording, weighted by their numbers of blocks; noise over
    lines around, *shared* as in lines_around, or *apart* of every force. DataError when the forces, or the
    outputs an estimator inverts, are not independent.
    """
    chosen = select_lines(spectra[0].frequency, settings)
    n_input = len(layout.inputs)
    if settings.estimator == "H1" and layout.one_force_each:
        return parts_of_single_forces(spectra, chosen, layout, shared, apart)
    matrix = at_lines(joined_spectra(spectra, layout), chosen)
    u, y = slice(n_input), slice(n_input, None)
    s_uu, s_yu, s_yy = matrix[:, u, u], matrix[:, y, u], matrix[:, y, y]
    quality.check_forces(s_uu, layout)
    if settings.estimator != "H1":
        quality.check_responses(s_yy, layout, settings.estimator)
    inverse_force, _ = definite_inverse(s_uu)
    first = product(s_yu, inverse_force)
    response = first if settings.estimator == "H1" else ESTIMATORS[settings.estimator](s_uu, s_yu, s_yy)
    averages = sum(spectrum.averages for spectrum in spectra)
    covariance: StoredCovariance = None
    half_width, dof = lines_around(averages - n_input, shared, len(response))
    if averages > n_input + 1:
        parts = (
            [at_lines(part, chosen) for part in shares_of(spectra, layout)] if len(spectra) > 1 else [matrix]
        )
        levels = levels_of(parts, response, inverse_force, [part.averages for part in spectra])
        if settings.estimator == "H1" and np.all(levels == 1):
            covariance = covariance_of_h1(matrix, response, inverse_force, averages, half_width)
        else:
            instruments = INSTRUMENTS[settings.estimator](response, np.einsum("faa->fa", matrix).real)
            covariance = covariance_of_random(
                matrix, response, instruments, averages, half_width, list(zip(parts, levels.T, strict=True))
            )
    return replace(
        _parts(spectra, response, covariance, quality.multiple_coherence(first, s_yu, s_yy), s_yy, layout),
        frequency=spectra[0].frequency[chosen],
        dof=np.inf if covariance is None else dof,
        coherence=quality.ordinary_coherence(s_uu, s_yu, s_yy),
        partial_coherence=quality.partial_coherence(
            np.einsum("fii->fi", inverse_force).real, first, s_yu, s_yy
        )
        if n_input > 1
        else None,
    )


def levels_of(
    parts: Sequence[ComplexArray],
    response: ComplexArray,
    inverse_force: ComplexArray,
    averages: Sequence[float],
) -> FloatArray:
    """Noise in every recording over that of all (n_output, n_recording) [1]; *parts* (n_line, n_channel,
    n_channel) of the spectra.
    """
    n_input = response.shape[2]
    if len(parts) == 1:
        return np.ones((response.shape[1], 1))
    left = [np.einsum("loo->lo", residual_spectrum(part, response)).real for part in parts]
    # A recording with most of the power of a force leaves little beside the common H.
    shares = (np.einsum("lij,lji->l", inverse_force, part[:, :n_input, :n_input]).real for part in parts)
    taken = [float(np.mean(share)) for share in shares]
    return noise_levels(np.stack(left, axis=2), np.array(averages) - taken)


def _parts(
    spectra: Sequence[CrossSpectra],
    response: ComplexArray,
    covariance: StoredCovariance,
    multiple: FloatArray,
    s_yy: ComplexArray,
    layout: Layout,
) -> Parts:
    averages = sum(spectrum.averages for spectrum in spectra)
    message = (
        f"{averages:.2g} effective averages are too few to estimate the noise of the FRF; hit more often, or "
        "record longer or shorten `block`"
    )
    return Parts(
        frequency=spectra[0].frequency,
        matrix=response,
        covariance=covariance,
        averages=averages,
        dof=np.inf,
        findings=(Finding("no-covariance", message),)
        if covariance is None
        else coherence_findings(multiple, np.einsum("foo->fo", s_yy).real, layout),
        multiple_coherence=multiple,
        line_correlation=spectra[0].line_correlation,
    )


def block_average(source: SampleSource, settings: FrfSettings, n_channel: int) -> WelchAverage:
    """The average of *n_channel* channels over the blocks of the settings, to be fed with the samples of a
    recording. Raises as block_samples and line_range.
    """
    assert settings.block is not None
    n_sample = block_samples(source, settings.block)
    step = max(1, round(n_sample * (1 - settings.overlap)))
    lines = line_range(n_sample, source.sample_rate, settings.band)
    return WelchAverage(window_values(settings.window, n_sample), step, n_channel, lines, settings.detrend)


def welch_average(
    source: SampleSource, settings: FrfSettings, of_half: Sequence[int] | None = None
) -> Halved:
    """Spectra of forces, responses and the named references of a recording, and those of its first half;
    DataError where it is short. *of_half*: channels of the recording whose columns are needed of its first
    half, by default all.
    """
    # Other references (tacho, temperature) are not part of the FRF matrix.
    columns = [
        number
        for number, channel in enumerate(source.channels)
        if channel.role != "reference" or channel.name in settings.reference
    ]
    average = block_average(source, settings, len(columns))
    half: CrossSpectra | None = None
    for block, ends_half in cut_at(checked_blocks(source), source.n_sample // 2):
        average.add(block if len(columns) == block.shape[1] else block[:, columns])
        if ends_half and source.n_sample // 2 >= average.n_sample:
            chosen = None if of_half is None else [columns.index(column) for column in of_half]
            half = _in_all_channels(
                average.spectra(source.sample_rate, chosen), columns, len(source.channels)
            )
    return _in_all_channels(average.spectra(source.sample_rate), columns, len(source.channels)), half


def _in_all_channels(spectra: CrossSpectra, columns: list[int], n_channel: int) -> CrossSpectra:
    places = [columns.index(number) if number in columns else -1 for number in range(n_channel)]
    rows = at_columns(spectra.matrix.swapaxes(1, 2), places, 1).swapaxes(1, 2)
    return replace(spectra, matrix=rows if rows.shape[2] < len(columns) else at_columns(rows, places, 1))


def parts_of_single_forces(
    spectra: Sequence[CrossSpectra], chosen: BoolArray, layout: Layout, shared: float, apart: bool
) -> Parts:
    """The FRF H = S_yu / S_uu column by column at the *chosen* lines (n_line,); spectra weighted by their
    numbers of blocks. The noise of the responses, S_yy - H S_uy, is that of a force's own recordings where
    *apart*: leakage differs from force to force and from line to line; so does, of hits, noise that grows
    with the force's own |H|^2, as noise of a hammer does, where each force has hits enough to tell it. Else
    it is that of all, brought to the level and the law of each by pooled_by_force. Both are averaged over
    lines around, *shared* as in lines_around.
    cov(H_oi, H_pi) = S_rr,i[o, p] / power_i, a block for every force. DataError for a force without power.
    """
    power, s_yu, by_force = _sum(spectra, chosen, layout)
    s_yy = by_force.sum(axis=1)
    quality.check_power(power)
    response = s_yu / power[:, None, :]
    averages, n_input = sum(spectrum.averages for spectrum in spectra), power.shape[1]
    covariance: StoredCovariance = None
    half_width, dof = lines_around(averages - n_input, shared, len(response))
    if averages > n_input + 1:
        noise = without_rounding(by_force - np.einsum("loi,lpi,li->liop", s_yu, s_yu.conj(), 1 / power))
        freedoms = _freedoms(spectra, layout)
        alone = np.all(freedoms > 0) and shared and _grows_with_response(noise, response, freedoms / shared)
        if apart or alone:
            around = [lines_around(freedom, shared, len(response)) for freedom in freedoms]
            columns = zip(noise.swapaxes(0, 1), response.transpose(2, 0, 1)[..., None], around, strict=True)
            noise = np.stack([pooled_residual(of, column, width) for of, column, (width, _) in columns], 1)
            # nu / (nu - n_output), by which weights enlarge a residual, is its mean over the forces.
            averaged = np.array([dof for _, dof in around])
            of_weights = averaged - len(layout.outputs)
            dof = float(np.sum(averaged / of_weights) / np.sum(1 / of_weights))
            freedoms = freedoms[:, None, None]
        else:
            # Levels of every response would turn what all of them share.
            is_shared = common_share(noise, freedoms) > MOST_SHARED
            noise, freedoms = pooled_by_force(noise, response, freedoms, half_width, is_shared), np.ones(1)
        elements = np.arange(response[0].size).reshape(-1, n_input).T
        covariance = BlockCovariance(elements, freeze_bases(noise / (power[:, :, None, None] * freedoms)))
    return replace(
        _parts(spectra, response, covariance, quality.multiple_coherence(response, s_yu, s_yy), s_yy, layout),
        frequency=spectra[0].frequency[chosen],
        dof=np.inf if covariance is None else dof,
        coherence=quality.coherence_by_power(power, s_yu, s_yy),
        partial_coherence=quality.partial_coherence(1 / power, response, s_yu, s_yy),
    )


def tells_noise_by_force(spectra: Sequence[CrossSpectra], layout: Layout) -> bool:
    """Whether the recordings of every force, of which none has much less than another, tell its noise so well
    that weights by it make the variance of a fit no more than MOST_LOST times as large.
    """
    dof, n_output = _freedoms(spectra, layout), len(layout.outputs)
    least = float(np.min(dof))
    enough = least > n_output and least**2 <= MOST_LOST * ((least - n_output) ** 2 - 1)
    return enough and least >= LEAST_SHARE * float(np.max(dof))


def _freedoms(spectra: Sequence[CrossSpectra], layout: Layout) -> FloatArray:
    return np.array([spectrum.averages for spectrum in spectra]) @ _acting(layout) - 1


def _grows_with_response(noise: ComplexArray, response: ComplexArray, dof: FloatArray) -> bool:
    """Whether *noise* (n_line, n_input, n_output, n_output) [any unit] of *dof* (n_input,) of a force's own
    recordings grows with its own *response* (n_line, n_output, n_input) [unit/N] in any of them.
    """
    power = np.einsum("lioo->ilo", noise).real
    columns = zip(power, response.transpose(2, 0, 1)[..., None], dof, strict=True)
    return len(dof) > 1 and any(
        n >= 1 and np.any(noise_shape(of_force, column, 1 / n) != 1) for of_force, column, n in columns
    )


def common_share(noise: ComplexArray, freedoms: FloatArray) -> float:
    """Mean squared coherence [1] of responses' *noise* (n_line, n_input, n_output, n_output) [any unit], less
    what chance gives of *freedoms* (n_input,) complex degrees of freedom; 0 of one response.
    """
    n_output, several = noise.shape[2], freedoms > 1
    if n_output == 1 or not np.any(several):
        return 0.0
    power = np.einsum("lioo->lio", noise).real
    whole = power[..., None] * power[..., None, :]
    squared = np.divide(np.abs(noise) ** 2, whole, out=np.zeros_like(whole), where=whole > 0).mean(axis=0)
    coherence = (squared.sum(axis=(1, 2)) - n_output) / (n_output * (n_output - 1))
    return float(np.sum((coherence * freedoms - 1)[several]) / np.sum(freedoms[several] - 1))


def _acting(layout: Layout) -> BoolArray:
    return np.array(layout.input_columns) >= 0


def _sum(
    spectra: Sequence[CrossSpectra], chosen: BoolArray, layout: Layout
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """S_uu (n_line, n_input) [N^2/Hz], S_yu (n_line, n_output, n_input) over all recordings; the part of S_yy
    from those of each force (n_line, n_input, n_output, n_output).
    """
    n_line, n_input, n_output = int(np.count_nonzero(chosen)), len(layout.inputs), len(layout.outputs)
    power = np.zeros((n_line, n_input))
    s_yu = np.zeros((n_line, n_output, n_input), np.complex128)
    by_force = np.zeros((n_line, n_input, n_output, n_output), np.complex128)
    n_block = sum(spectrum.n_block for spectrum in spectra)
    for spectrum, inputs, outputs in zip(spectra, layout.input_columns, layout.output_columns, strict=True):
        ((force, column),) = [(number, column) for number, column in enumerate(inputs) if column >= 0]
        matrix, rows, share = spectrum.matrix[chosen], list(outputs), spectrum.n_block / n_block
        power[:, force] += share * matrix[:, column, column].real
        s_yu[:, :, force] += share * matrix[:, rows, column]
        by_force[:, force] += share * matrix[:, rows][:, :, rows]
    return power, s_yu, by_force
