"""The section live of a pipeline: what a test is to reach, and its course, average by average."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import difference_in, shown_unit, unit_label
from labpipe.estimation.settings import FitSettings
from labpipe.methods.live.bench import Bench, obstacle
from labpipe.methods.live.charts import Goal, Update
from labpipe.methods.live.sources import MOST_ROWS
from labpipe.project.ingest import ingest, unique_names
from labpipe.project.tests import Test
from labpipe.project.work import Work
from labpipe.quantities import to_display
from labpipe.records.identification import Identification
from labpipe.records.sections import PipelineSection
from labpipe.records.settings import Settings, setting
from labpipe.report.chart import Axis, Panel, curve, level, stack
from labpipe.report.document import Block, Figure, Paragraph, Section
from labpipe.spectra.settings import FrfSettings

# Coefficients that are drawn where nothing is asked for.
DRAWN = 4


@dataclass(frozen=True)
class LiveSettings(Settings):
    """What a test is to reach."""

    until: tuple[str, ...] = setting(
        "names", "goals, each on the width of an interval: k.expanded<=1%", default=()
    )
    test: tuple[str, ...] = setting("names", "tests whose course is shown; default: all", default=())

    def __post_init__(self) -> None:
        for text in self.until:
            Goal.of(text)

    @property
    def goals(self) -> list[Goal]:
        return [Goal.of(text) for text in self.until]


@dataclass(frozen=True)
class CoefficientCourse:
    """A coefficient's *value* and *half*-width (n,) [unit] after so many *averages* (n,), and its *goal*."""

    name: str
    unit: str
    averages: FloatArray
    value: FloatArray
    half: FloatArray
    goal: float | None = None


@dataclass(frozen=True)
class Course:
    """The course of a *test* of so many *averages* (each a *what*: period or hit); *enough*: after how many
    every goal was reached; *left_out*: averages that do not count, with their reason.
    """

    test: str
    what: str
    averages: int
    coefficients: tuple[CoefficientCourse, ...]
    goals: tuple[str, ...] = ()
    enough: int | None = None
    left_out: tuple[str, ...] = ()


Courses = tuple[Course, ...]


def coefficients_of(updates: Sequence[Update]) -> tuple[CoefficientCourse, ...]:
    """Every coefficient that is asked for, or the first of them, over the averages."""
    there = [update for update in updates if update.standings]
    if len(there) < 2:
        return ()
    last = there[-1].standings
    wanted = [name for name, standing in last.items() if standing.goal is not None] or list(last)[:DRAWN]
    courses = []
    for name in wanted:
        finite = [u for u in there if name in u.standings and math.isfinite(u.standings[name].half)]
        if len(finite) >= 2:
            n = np.array([u.averages for u in finite], float)
            value = np.array([u.standings[name].parameter.value for u in finite])
            half = np.array([u.standings[name].half for u in finite])
            course = CoefficientCourse(name, last[name].parameter.unit, n, value, half, last[name].goal)
            courses.append(course)
    return tuple(courses)


def course_figure(coefficients: Sequence[CoefficientCourse]) -> Figure:
    panels = []
    for course in coefficients:
        unit = shown_unit(course.unit, float(course.value[-1]), None)
        value = np.array([to_display(number, unit) for number in course.value])
        half = np.array([difference_in(number, unit) for number in course.half])
        series = [curve(course.name, course.averages, value, band=(value - half, value + half), marker=".")]
        if course.goal is not None:
            width = difference_in(course.goal, unit)
            series += [level(value[-1] + sign * width, name="goal") for sign in (-1, 1)]
        panels.append(Panel(Axis("averages"), Axis(course.name, unit_label(unit)), tuple(series)))
    caption = (
        "Coefficients with their 95 % intervals after each average; lines: the goal around the last value."
    )
    return Figure(stack(panels, 1.8 * len(panels) + 0.8), caption, "Coefficients over the averages")


def run_live(settings: LiveSettings, work: Work) -> Courses:
    """The course of every test whose fits can be followed average by average."""
    courses = []
    # The names that the run gives to calibrated recordings.
    names = iter(unique_names([s.path for test in work.pipeline.tests for s in test.recordings]))
    for test in work.pipeline.tests:
        of_test = [next(names) for _ in test.recordings]
        frf = test.frf or work.pipeline.frf
        fits = [fit for fit in work.pipeline.fits if not fit.test or test.name in fit.test]
        chosen = not settings.test or test.name in settings.test
        if chosen and fits and test.recordings and frf is not None:
            courses += _course(test, frf, fits, settings, work, of_test)
    return tuple(courses)


def _course(
    test: Test,
    frf: FrfSettings,
    fits: Sequence[FitSettings],
    settings: LiveSettings,
    work: Work,
    names: Sequence[str],
) -> list[Course]:
    """The course of a test, none where no fit of it can be followed."""
    bench: Bench | None = None
    enough, left_out = None, []
    for source, name in zip(test.recordings, names, strict=True):
        place = f"recordings/{name}"
        recording = ingest(
            source.path, source.rig, work.output, place, work.pipeline.folder, source.joined, source.by
        )
        if bench is None:
            channels, rate = recording.channels, recording.sample_rate
            plain = [replace(fit, test=()) for fit in fits if not obstacle(fit, frf, channels, rate)]
            if not plain:
                return []
            bench = Bench(recording.channels, recording.sample_rate, frf, plain, settings.goals)
        else:
            bench.restart()
        for block in recording.blocks(MOST_ROWS):
            for update in bench.add(block):
                if update.stop and enough is None:
                    enough = update.averages
                left_out += [event for event in update.events if "left out" in event]
    assert bench is not None
    coefficients = coefficients_of(bench.updates)
    return [
        Course(test.name, bench.what, bench.averages, coefficients, settings.until, enough, tuple(left_out))
    ]


def course_lines(courses: Courses) -> Iterator[str]:
    for course in courses:
        yield f"live{f' {course.test}' if course.test else ''}: {_sentence(course)}"


def _sentence(course: Course) -> str:
    count = f"{course.averages} {course.what}{'s' if course.averages != 1 else ''}"
    if not course.goals:
        return f"{count}, no goal was set"
    goals = f"the goals ({', '.join(course.goals)})"
    return (
        f"{goals} were not reached within {count}"
        if course.enough is None
        else f"{goals} were reached after {course.enough} of {count}"
    )


def course_sections(courses: Courses, _identification: Identification) -> tuple[Section, ...]:
    """The course of each test: a sentence, a figure, the averages that do not count."""
    sections = []
    for course in courses:
        sentence = _sentence(course)
        blocks: list[Block] = [Paragraph(f"{sentence[0].upper()}{sentence[1:]}.", "note")]
        if course.coefficients:
            blocks.append(course_figure(course.coefficients))
        blocks += [Paragraph(event, "warning") for event in course.left_out]
        title = f"Course of the test {course.test}".strip()
        sections.append(Section(title, tuple(blocks)))
    return tuple(sections)


LIVE = PipelineSection(
    words="What a test is to reach, and its course average by average.",
    settings=LiveSettings,
    run=run_live,
    record=Courses,
    entry="courses",
    report=course_sections,
    terminal=course_lines,
)
