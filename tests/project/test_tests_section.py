"""Which files are which test, and under which conditions: globs, lists, names, `each`, and every fault at its
place.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from labpipe.errors import ConfigErrors
from labpipe.project.pipeline_file import Pipeline, load_pipeline
from labpipe.project.settings_reader import conditions_in
from labpipe.records.rig import Span

RIG = (
    "name: {name}\nsample_rate: 1 kHz\nmass: {mass}\nchannels:\n  f: {{quantity: force, dof: x}}\n  x: "
    "{{quantity: displacement}}\n"
)
FRF = "frf: {excitation: periodic, period: 1 s}\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "rig.yaml").write_text(RIG.format(name="R", mass="2 kg"))
    (tmp_path / "moved.yaml").write_text(RIG.format(name="Moved", mass="3 kg"))
    (tmp_path / "runs/deep").mkdir(parents=True)
    for name in ("runs/b.csv", "runs/a.csv", "runs/deep/c.csv", "runs/427N-up.csv", "runs/701N-down.csv"):
        (tmp_path / name).write_text("f,x\n1,2\n")
    (tmp_path / "h.frf.csv").write_text("frequency_hz,x/f:re,x/f:im\n1,2,3\n2,3,4\n")
    return tmp_path


def load(folder: Path, text: str) -> Pipeline:
    (folder / "p.yaml").write_text(text)
    return load_pipeline(folder / "p.yaml")


def faults(folder: Path, text: str) -> list[str]:
    with pytest.raises(ConfigErrors) as caught:
        load(folder, text)
    return [str(fault).removeprefix(f"{folder}/") for fault in caught.value.faults]


def files(pipeline: Pipeline) -> list[list[str]]:
    return [
        [source.path.relative_to(pipeline.folder).as_posix() for source in test.recordings]
        for test in pipeline.tests
    ]


@pytest.mark.parametrize(
    ("entry", "found"),
    [
        ("runs/a.csv", ["runs/a.csv"]),
        ("[runs/b.csv, runs/a.csv]", ["runs/b.csv", "runs/a.csv"]),
        ("'runs/?.csv'", ["runs/a.csv", "runs/b.csv"]),
        ("'runs/**/c.csv'", ["runs/deep/c.csv"]),
        ("['runs/*N-*.csv', runs/a.csv]", ["runs/427N-up.csv", "runs/701N-down.csv", "runs/a.csv"]),
    ],
)
def test_files_lists_and_globs(folder: Path, entry: str, found: list[str]) -> None:
    """A list keeps its order, a glob is sorted."""
    assert files(load(folder, f"rig: rig.yaml\nrecordings: {entry}\n{FRF}")) == [found]


def test_the_recordings_of_a_plain_pipeline_are_one_test_without_a_name(folder: Path) -> None:
    (test,) = load(
        folder, f"rig: rig.yaml\nrecordings: runs/a.csv\nconditions: {{preload: 427 N}}\n{FRF}"
    ).tests
    assert (test.name, test.conditions, test.frfs) == ("", {"preload": "427 N"}, ())


def test_tests_without_a_name_are_numbered(folder: Path) -> None:
    text = (
        "rig: rig.yaml\ntests:\n  - {recordings: runs/a.csv}\n  - {name: b, recordings: "
        f"runs/b.csv}}\n  - {{frfs: h.frf.csv}}\n{FRF}"
    )
    assert [test.name for test in load(folder, text).tests] == ["1", "b", "3"]


def test_ready_responses_need_no_rig(folder: Path) -> None:
    (test,) = load(folder, "frfs: h.frf.csv\nidentify: {a: {model: sdof}}\n").tests
    assert [path.name for ready in test.frfs for path in ready.paths] == [
        "h.frf.csv"
    ] and test.recordings == ()


def test_a_recording_may_have_a_rig_of_its_own(folder: Path) -> None:
    text = f"rig: rig.yaml\nrecordings: [runs/a.csv, {{file: runs/b.csv, rig: moved.yaml}}]\n{FRF}"
    (test,) = load(folder, text).tests
    assert [source.rig.name for source in test.recordings] == ["R", "Moved"]


@pytest.mark.parametrize(
    ("rig", "said"),
    [
        ("name: R\n", "channels.f: the rig has no such channel; known: none"),
        ("channels: [f]\n", "channels: a mapping of keys to values is needed"),
        ("channels: {f: }\n", "channels.f: a mapping of keys to values is needed"),
    ],
)
def test_entries_of_a_channel_that_the_rig_does_not_describe(folder: Path, rig: str, said: str) -> None:
    (folder / "rig.yaml").write_text(rig)
    text = f"tests: [{{recordings: {{file: runs/a.csv, rig: rig.yaml, channels: {{f: {{dof: y}}}}}}}}]\n{FRF}"
    assert any(said in fault for fault in faults(folder, text))


def test_a_name_with_a_point_is_whole(folder: Path) -> None:
    """1.5 kN is not 1."""
    for name in ("load 1.5 kN.csv", "load 2.5 kN.recording.parquet"):
        (folder / name).write_text("f,x\n1,2\n")
    tests = load(folder, f"rig: rig.yaml\ntests: [{{each: 'load*', pattern: 'load {{load}}'}}]\n{FRF}").tests
    found = [(test.name, test.conditions["load"]) for test in tests]
    assert found == [("load 1.5 kN", "1.5 kN"), ("load 2.5 kN", "2.5 kN")]


def test_a_recording_counts_once_with_one_rig(folder: Path) -> None:
    """Twice it would halve the variance of what it says; with other channels it may say something else."""
    twice = f"rig: rig.yaml\nrecordings: [runs/a.csv, 'runs/?.csv']\n{FRF}"
    (fault,) = faults(folder, twice)
    assert fault == "p.yaml:2:26: recordings: 'a.csv' is named twice; a recording counts once"
    moved = twice.replace("'runs/?.csv'", "{file: runs/a.csv, rig: moved.yaml}")
    assert files(load(folder, moved)) == [["runs/a.csv", "runs/a.csv"]]


def test_one_recording_s_channels_leave_the_others_alone(folder: Path) -> None:
    text = (
        f"rig: rig.yaml\nrecordings: [{{file: runs/a.csv, channels: {{f: {{dof: y}}}}}}, runs/b.csv]\n{FRF}"
    )
    (test,) = load(folder, text).tests
    assert [source.rig.channels[0].channel.dof for source in test.recordings] == ["y", "x"]


def test_every_file_a_test_of_its_own(folder: Path) -> None:
    entry = "{each: 'runs/*N-*.csv', pattern: '{preload}-{way}', conditions: {speed: 0 rpm}}"
    text = f"rig: rig.yaml\ntests:\n  - {entry}\n{FRF}"
    tests = load(folder, text).tests
    assert [test.name for test in tests] == ["427N-up", "701N-down"]
    assert tests[0].conditions == {"speed": "0 rpm", "way": "up", "preload": "427N"}


def test_dofs_in_the_names_of_recordings(folder: Path) -> None:
    """A roving hammer names its channel or its role; an angle is kept where the name is an axis."""
    for word in ("f", "input"):
        text = (
            "rig: rig.yaml\nrecordings: {each: ['runs/a.csv', 'runs/427N-up.csv'], pattern: "
            f"'{{{word}}}'}}\n{FRF}"
        )
        (test,) = load(folder, text.replace("each: [", "each: [runs/b.csv, ")).tests
        assert [source.rig.channels[0].channel.dof for source in test.recordings] == ["b", "a", "427N-up"]
    (test,) = load(
        folder, f"rig: rig.yaml\nrecordings: {{file: 'runs/*N-*.csv', pattern: '{{x}}-{{f}}'}}\n{FRF}"
    ).tests
    assert [[c.channel.dof for c in source.rig.channels] for source in test.recordings] == [
        ["up", "427N"],
        ["down", "701N"],
    ]


def test_channels_of_one_run_in_several_files(folder: Path) -> None:
    (test,) = load(
        folder, f"rig: rig.yaml\nrecordings: [{{join: ['runs/?.csv'], by: sample}}, runs/b.csv]\n{FRF}"
    ).tests
    assert [
        (source.path.name, [path.name for path in source.joined], source.by) for source in test.recordings
    ] == [("a.csv", ["b.csv"], "sample"), ("b.csv", [], "")]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (
            "recordings: {each: 'runs/?.csv', pattern: 'p_{f}'}\n",
            "p.yaml:2:34: recordings.pattern: does not match 'a'; for example",
        ),
        (
            "recordings: {each: 'runs/?.csv', pattern: '{g}'}\n",
            "recordings.pattern: 'g' is not a channel of the rig; known: f, x",
        ),
        (
            "recordings: {each: 'runs/?.csv', pattern: '{reference}'}\n",
            "recordings.pattern: 'reference' is not a channel of the rig",
        ),
        (
            "recordings: {file: runs/a.csv, join: runs/b.csv}\n",
            "recordings.join: 'file' and 'join' are both named; leave one out",
        ),
        (
            "recordings: {join: 'runs/?.csv', by: line}\n",
            "recordings.by: unknown 'line'; known: time, sample",
        ),
        (
            "recordings: {file: runs/a.csv, by: time}\n",
            "recordings.by: belongs to files that are joined; write join: [a.csv, b.csv]",
        ),
        (
            "recordings: runs/z.csv\n",
            "p.yaml:2:1: recordings: no such file 'runs/z.csv'; paths are relative to the file that names "
            "them",
        ),
        (
            "recordings: 'z*.csv'\n",
            "p.yaml:2:1: recordings: no file matches 'z*.csv'; paths are relative to the pipeline file",
        ),
        ("recordings: [{rig: rig.yaml}]\n", "p.yaml:2:14: recordings: a file name is needed"),
        ("title: [a]\nrecordings: runs/a.csv\n", "p.yaml:2:1: title: a text is missing"),
        ("tests: [{name: {a: b}, recordings: runs/a.csv}]\n", "tests.1.name: a text is missing"),
        ("recordings: [{file: runs/a.csv, rig: {}}]\n", "p.yaml:2:33: recordings.rig: a file name is needed"),
        (
            "recordings: [{file: runs/a.csv, rig: [], channels: {f: {dof: y}}}]\n",
            "recordings.rig: a file name is needed",
        ),
        (
            "recordings: [{file: runs/a.csv, rigg: rig.yaml}]\n",
            "recordings.rigg: unknown key; did you mean 'rig'?",
        ),
        ("recordings: [{file: runs/a.csv, rig: none.yaml}]\n", "recordings.rig: no such file 'none.yaml'"),
        (
            "recordings: [{file: runs/a.csv, channels: {g: {dof: y}}}]\n",
            "recordings.channels.g: the rig has no such channel",
        ),
        (
            "tests: runs/a.csv\n",
            "p.yaml:2:1: tests: a list of tests is needed; each begins with '- name: ...'",
        ),
        ("tests: [{nam: a, recordings: runs/a.csv}]\n", "tests.1.nam: unknown key; did you mean 'name'?"),
        ("tests: [{name: a}]\n", "tests.1: neither recordings nor frfs"),
        (
            "tests: [{each: 'runs/?.csv', pattern: '{a}-{b}'}]\n",
            "tests.1.pattern: does not match 'a', nor 1 more; for example",
        ),
        ("tests: [{each: 'runs/?.csv', recordings: runs/a.csv}]\n", "tests.1.recordings: unknown key"),
        (
            "tests: [{name: a, recordings: runs/a.csv, conditions: 427 N}]\n",
            "conditions: a mapping of keys to values is needed",
        ),
        (
            "conditions: {load: 1 N}\ntests: [{recordings: runs/a.csv}]\n",
            "p.yaml:2:1: conditions: has no effect",
        ),
        (
            "recordings: runs/b.csv\ntests: [{recordings: runs/a.csv}]\n",
            "p.yaml:2:1: recordings: has no effect",
        ),
        (
            "tests: [{each: 'runs/4*.csv', pattern: '{a}-{b}', conditions: {a: 4 N}}]\n",
            "conditions.a: is in the pattern as well",
        ),
    ],
)
def test_faults_of_tests(folder: Path, text: str, fault: str) -> None:
    found = faults(folder, f"rig: rig.yaml\n{text}{FRF}")
    assert any(fault in one for one in found), found


def test_a_rig_that_is_broken_is_named_once_with_its_own_place(folder: Path) -> None:
    (folder / "rig.yaml").write_text(RIG.format(name="R", mass="2 m"))
    found = faults(folder, f"rig: rig.yaml\nrecordings: runs/a.csv\n{FRF}")
    (about_mass,) = (one for one in found if "mass" in one)
    assert about_mass == "rig.yaml:3:1: mass: 'm' has the wrong dimension, kg is needed; for example '0.5 kg'"


def test_a_rig_that_is_read_for_several_recordings_is_named_once(folder: Path) -> None:
    """It is read again wherever a recording moves a channel."""
    (folder / "rig.yaml").write_text(RIG.format(name="R", mass="2 m"))
    moved = ", ".join(f"{{file: runs/{name}.csv, channels: {{f: {{dof: {name}}}}}}}" for name in "ab")
    found = faults(folder, f"rig: rig.yaml\nrecordings: [{moved}]\n{FRF}")
    assert len([one for one in found if "mass" in one]) == 1


# conditions in names

WORDS = st.text("abcXYZ0189", min_size=1, max_size=5)


@given(st.lists(WORDS, min_size=1, max_size=4), st.sampled_from(["-", "_", "--", " by "]))
def test_a_pattern_takes_a_name_apart_as_it_was_put_together(words: list[str], between: str) -> None:
    pattern = between.join(f"{{c{number}}}" for number in range(len(words)))
    assert conditions_in(between.join(words), pattern) == {
        f"c{number}": word for number, word in enumerate(words)
    }


@given(st.lists(WORDS, min_size=2, max_size=4), st.integers(0, 3))
def test_a_part_without_a_name_is_no_condition(words: list[str], place: int) -> None:
    place = min(place, len(words) - 1)
    pattern = "-".join("{}" if number == place else f"{{c{number}}}" for number in range(len(words)))
    assert conditions_in("-".join(words), pattern) == {
        f"c{n}": word for n, word in enumerate(words) if n != place
    }


@pytest.mark.parametrize(
    ("name", "pattern"),
    [("427N", "{a}-{b}"), ("427N-", "{a}-{b}"), ("-up", "{a}-{b}"), ("a.b", "a+b"), ("xa", "a"), ("", "{a}")],
)
def test_a_name_of_another_form_has_no_conditions(name: str, pattern: str) -> None:
    assert conditions_in(name, pattern) is None


def test_signs_of_a_pattern_are_letters_and_no_expressions() -> None:
    assert conditions_in("a.b(1)+", "a.b({n})+") == {"n": "1"}
    assert conditions_in("axb(1)+", "a.b({n})+") is None


EACH_SPEED = (
    "rig: rig.yaml\n"
    + FRF
    + ("tests:\n  - each: 'runs/speed*.csv'\n    pattern: '{speed}-{load}-{shaker}'\n")
)


def speed_runs(folder: Path) -> None:
    for name in ("speed50Hz-1kN-x", "speed50Hz-1kN-y", "speed80Hz-1kN-x", "speed80Hz-1kN-y"):
        (folder / f"runs/{name}.csv").write_text("f,x\n1,2\n")


def test_files_that_differ_only_in_a_named_part_are_one_test(folder: Path) -> None:
    speed_runs(folder)
    pipeline = load(folder, EACH_SPEED.replace("'{speed}", "'speed{speed}") + "    together: shaker\n")
    assert [test.name for test in pipeline.tests] == ["50Hz-1kN", "80Hz-1kN"]
    assert files(pipeline)[0] == ["runs/speed50Hz-1kN-x.csv", "runs/speed50Hz-1kN-y.csv"]
    assert pipeline.tests[1].conditions == {"speed": "80Hz", "load": "1kN"}


def test_a_part_that_the_pattern_lacks_is_named(folder: Path) -> None:
    speed_runs(folder)
    found = faults(
        folder, EACH_SPEED.replace("'{speed}", "'speed{speed}") + "    together: [shaker, direction]\n"
    )
    assert [fault for fault in found if "together: the pattern has no part '{direction}'" in fault] == found[
        :1
    ]


def test_a_condition_may_be_recorded(folder: Path) -> None:
    entry = "conditions: {load: {channel: x}, speed: {tacho: f, pulses: 2}, oil: VG32}\n"
    (test,) = load(folder, f"rig: rig.yaml\nrecordings: runs/a.csv\n{entry}{FRF}").tests
    assert test.conditions == {"oil": "VG32"}
    assert (test.recorded["load"].channel, test.recorded["speed"].tacho, test.recorded["speed"].pulses) == (
        "x",
        "f",
        2,
    )


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("{load: {channel: x, puls: 2}}", "conditions.load.puls: unknown key; did you mean 'pulses'?"),
        ("{load: {channel: x, tacho: f}}", "conditions.load: one of 'channel' and 'tacho' is needed"),
        ("{load: {tacho: f, pulses: 0}}", "pulses must be positive"),
    ],
)
def test_faults_of_recorded_conditions(folder: Path, entry: str, message: str) -> None:
    (fault,) = faults(folder, f"rig: rig.yaml\nrecordings: runs/a.csv\nconditions: {entry}\n{FRF}")
    assert message in fault


def test_a_ready_frf_has_no_channel_to_take_a_condition_from(folder: Path) -> None:
    (fault,) = faults(folder, "frfs: h.frf.csv\nconditions: {load: {channel: x}}\n")
    assert "a ready FRF has no channels to take conditions from; write the amount" in fault


def test_a_test_may_have_its_spectra_made_otherwise(folder: Path) -> None:
    """The test's own entries take the place of the pipeline's, an empty one takes it away."""
    frf = "frf: {excitation: periodic, period: 1 s, band: 1-100 Hz, mask: {speed: 50 Hz}}\n"
    own = (
        "  - {name: dry, recordings: runs/a.csv, frf: {band: 5-50 Hz, mask: }}\n  - {name: wet, "
        "recordings: runs/b.csv}\n"
    )
    dry, wet = load(folder, f"rig: rig.yaml\n{frf}tests:\n{own}").tests
    assert dry.frf is not None and wet.frf is None
    assert (dry.frf.excitation, dry.frf.band, dry.frf.mask) == ("periodic", (5.0, 50.0), None)


def test_a_test_of_another_excitation_takes_over_what_that_takes(folder: Path) -> None:
    """Taps of the free rotor beside a shaker's periods: the band stays, period and skip are not for hits."""
    frf = "frf: {excitation: periodic, period: 1 s, skip: 2, band: 1-100 Hz}\n"
    taps = "  - {name: taps, recordings: runs/a.csv, frf: {excitation: impact, block: 2 s}}\n"
    (test,) = load(folder, f"rig: rig.yaml\n{frf}tests:\n{taps}").tests
    assert test.frf is not None
    assert (test.frf.excitation, test.frf.block, test.frf.band) == ("impact", 2.0, (1.0, 100.0))
    (fault,) = faults(folder, f"rig: rig.yaml\n{frf}tests:\n{taps.replace('block', 'period: 1 s, block')}")
    assert "tests.1.frf.period: 'period' is not for impact excitation" in fault


def test_faults_of_a_test_s_own_spectra_stand_at_their_place(folder: Path) -> None:
    text = f"rig: rig.yaml\n{FRF}tests:\n  - {{name: dry, recordings: runs/a.csv, frf: {{perod: 2 s}}}}\n"
    (fault,) = faults(folder, text)
    assert fault.startswith("p.yaml:4:") and "tests.1.frf.perod: unknown key; did you mean 'period'?" in fault


def test_a_part_that_stands_twice_in_a_pattern_is_the_same_in_both_places() -> None:
    assert conditions_in("1kN-run-1kN", "{load}-{}-{load}") == {"load": "1kN"}
    assert conditions_in("1kN-2kN", "{load}-{load}") is None


@pytest.mark.parametrize("amount", ["[1 kN, 2 kN]", "", "null", "''"])
def test_a_condition_without_an_amount_is_refused(folder: Path, amount: str) -> None:
    text = f"rig: rig.yaml\nrecordings: runs/a.csv\nconditions: {{load: {amount}}}\n{FRF}"
    assert faults(folder, text) == [
        "p.yaml:3:14: conditions.load: an amount or a word is needed; for example speed: 3000 rpm"
    ]


def test_files_of_one_test_say_what_their_repeats_are(folder: Path) -> None:
    entry = "{each: runs/*N-*.csv, pattern: '{load}-{run}', together: run, repeats: pool}"
    tests = load(folder, f"rig: rig.yaml\ntests: [{entry}]\n{FRF}").tests
    assert [(test.name, test.repeats) for test in tests] == [("427N", "pool"), ("701N", "pool")]
    wrong = faults(folder, f"rig: rig.yaml\ntests: [{entry.replace('pool', 'poll')}]\n{FRF}")
    assert wrong == ["p.yaml:2:71: tests.1.repeats: unknown 'poll'; write each or pool"]


def test_a_calibrated_recording_keeps_its_channels(folder: Path) -> None:
    """Its dofs, delays and tables are those it was made with: entries that say others would do nothing."""
    (folder / "a.recording.parquet").touch()
    for entry, place in (("channels: {x: {dof: y}}", 41), ("pattern: '{output}'", 41), ("end: 1 s", 41)):
        text = f"rig: rig.yaml\nrecordings: {{file: a.recording.parquet, {entry}}}\n{FRF}"
        word = entry.partition(":")[0]
        what = "'a.recording.parquet' is calibrated and stays as it is"
        hint = "name the raw file, or leave it out"
        assert faults(folder, text) == [f"p.yaml:2:{place}: recordings.{word}: {what}; {hint}"]


def test_a_listed_sum_is_a_channel_that_a_recording_may_move(folder: Path) -> None:
    derived = "derived:\n  d: {sum: {x: 2}, quantity: displacement, dof: y}\n"
    (folder / "rig.yaml").write_text(RIG.format(name="R", mass="2 kg") + derived)
    text = f"rig: rig.yaml\nrecordings: {{file: runs/a.csv, channels: {{d: {{dof: z}}}}}}\n{FRF}"
    (source,) = load(folder, text).tests[0].recordings
    assert source.rig.derived[0].dof == "z"


def test_files_of_a_channel_lie_beside_what_names_them(folder: Path) -> None:
    """A table that the pipeline names lies beside the pipeline, one that the rig file names beside that."""
    for place, gain in (("probe.csv", 2), ("runs/probe.csv", 3)):
        (folder / place).write_text(f"frequency_hz,gain,phase_deg\n0,{gain},0\n500,{gain},0\n")
    (folder / "runs/rig.yaml").write_text(
        RIG.format(name="R", mass="2 kg").replace("ment}", "ment, response: probe.csv}")
    )
    for entry, gain in (("", 3.0), (", channels: {x: {response: probe.csv}}", 2.0)):
        text = f"rig: runs/rig.yaml\nrecordings: {{file: runs/a.csv{entry}}}\n{FRF}"
        (source,) = load(folder, text).tests[0].recordings
        assert source.rig.channels[1].channel.response[0] == (0.0, gain, 0.0)


def test_parts_of_one_file_are_recordings_of_their_own(folder: Path) -> None:
    parts = "[{file: runs/a.csv, end: 9 s}, {file: runs/a.csv, start: 0.5 min}]"
    (test,) = load(folder, f"rig: rig.yaml\nrecordings: {parts}\n{FRF}").tests
    assert [(source.path.name, source.span) for source in test.recordings] == [
        ("a.csv", Span(0.0, 9.0)),
        ("a.csv", Span(30.0, None)),
    ]
    for entry, said in (
        ("start: 9 s, end: 9 s", "2:44: recordings.end: 'end' must come after 'start'"),
        ("strat: 9 s", "2:32: recordings.strat: unknown key; did you mean 'start'?"),
        ("start: 9", "2:32: recordings.start: '9' has no unit; write it with its unit, e.g. '9 s'"),
    ):
        text = f"rig: rig.yaml\nrecordings: {{file: runs/a.csv, {entry}}}\n{FRF}"
        assert faults(folder, text) == [f"p.yaml:{said}"]
