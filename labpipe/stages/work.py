"""What the sections of a pipeline work on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field

from labpipe.artefacts.writing import OutputFolder
from labpipe.config.pipeline import Pipeline
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.identification import Failed, Fit
from labpipe.records.response import FrequencyResponse
from labpipe.stages.measured import MeasuredTest

Tell = Callable[[str], None]
# What names a failed comparison among failed tests.
COMPARE_PREFIX = "compare."


@dataclass(frozen=True)
class Work:
    """A pipeline whose recordings have been measured.

    tests: the response, the free decays or the spectra of every test. test_fits: fits already made test by test, by their name in the
    pipeline.
    fits: those of the sections so far. failed: tests that are missing, and comparisons that cannot do without them; *go_on* then.
    *jobs*: processes of a study, 0 for one per processor.
    """

    pipeline: Pipeline
    tests: Sequence[MeasuredTest]
    output: OutputFolder
    _: KW_ONLY
    tell: Tell = lambda _: None
    jobs: int = 0
    test_fits: Mapping[str, Sequence[Fit]] = field(default_factory=dict)
    fits: list[Fit] = field(default_factory=list)
    failed: list[Failed] = field(default_factory=list)

    @property
    def responses(self) -> list[FrequencyResponse]:
        """The frequency responses among what was measured."""
        return [test for test in self.tests if isinstance(test, FrequencyResponse)]

    @property
    def spectra(self) -> list[ChannelSpectra]:
        """The spectra of all channels among what was measured."""
        return [test for test in self.tests if isinstance(test, ChannelSpectra)]

    @property
    def go_on(self) -> bool:
        """True if what lacks a test is named and passed over."""
        return bool(self.failed)
