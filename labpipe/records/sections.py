"""Sections of a pipeline that ask for a result. SECTIONS by their key: how each is read, run, recorded,
judged, listed and reported.

Methods and other packages add sections under the entry-point group labpipe.section; one is loaded when a
pipeline or a result has it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from labpipe.registry import Registry


def _nothing(*_: Any) -> tuple[()]:
    return ()


def _no_facts(_: Any) -> Mapping[str, str]:
    return {}


@dataclass(frozen=True, kw_only=True)
class PipelineSection:
    """One section.

    words: what it does, for the docs. settings: the dataclass of the section, or of each of its entries where
    they are *named*. run: (settings, Work) -> its record. record: the type of the record, from which JSON is
    read back; entry: its key in identification.json. *standalone*: the section alone is work for a pipeline.
    *fits*: its record is a tuple of fits, held with those of all others.

    Optional: read: (node, key, name, Reading) -> settings, where more than the dataclass is needed; names:
    settings or record -> the names by which rules address it; verdicts: settings -> (name, all verdicts that
    a rule may ask for under it) pairs, any word where none are given; outcome: (rule, record, compare) ->
    RuleOutcome; findings: record -> (origin, finding) pairs; parameters: record -> ListedParameters; report:
    (record, Identification) -> sections of the report; cover: record -> what the cover says of it; terminal:
    record -> lines.
    """

    words: str
    settings: type[Any]
    run: Callable[[Any, Any], Any]
    named: bool = False
    standalone: bool = False
    fits: bool = False
    record: Any = None
    entry: str = ""
    read: Callable[[Any, str, str, Any], Any] | None = None
    names: Callable[[Any], Iterable[str]] | None = None
    verdicts: Callable[[Any], Iterable[tuple[str, tuple[str, ...]]]] = _nothing
    outcome: Callable[[Any, Any, Any], Any] | None = None
    findings: Callable[[Any], Iterable[Any]] = _nothing
    parameters: Callable[[Any], Iterable[Any]] = _nothing
    report: Callable[[Any, Any], Iterable[Any]] = _nothing
    cover: Callable[[Any], Mapping[str, str]] = _no_facts
    terminal: Callable[[Any], Iterable[str]] = _nothing


SECTIONS = Registry("section")


def section(name: str) -> PipelineSection:
    """The section of that key; ConfigError with the nearest known key on a miss."""
    entry: PipelineSection = SECTIONS.load(name)
    return entry


def sections(keys: Iterable[str] | None = None) -> list[tuple[str, PipelineSection]]:
    """The sections with these keys, or all, in the order in which they are run: those whose records are fits
    come first.
    """
    named = None if keys is None else set(keys)
    loaded = [(name, section(name)) for name in SECTIONS.names() if named is None or name in named]
    return sorted(loaded, key=lambda pair: not pair[1].fits)


def names_of(name: str, settings_or_record: Any) -> tuple[str, ...]:
    """The names by which rules address a section: its own key, unless it has names."""
    names = section(name).names
    return (name,) if names is None else tuple(names(settings_or_record))
