"""The words of docs/glossary.md are used, and none of those that they replaced, in code, comments and docs."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [
    path
    for folder in ("src", "tests", "bench", "examples", "docs")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in {".py", ".md", ".yaml", ".j2"} and path != Path(__file__)
] + [
    ROOT / name for name in ("README.md", "CONVENTIONS.md", "CONTRIBUTING.md", "CHANGELOG.md") if (ROOT / name).exists()
]
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")  # the words inside snake_case and CamelCase too
RETIRED = {
    "spot": "detection, or blob where pixels are meant",
    "spots": "detections",
    "balance": "centroid",
    "naming": "association, assignment or hypothesis",
    "namings": "associations, assignments or hypotheses",
    "belief": "hypothesis or track",
    "beliefs": "hypotheses or tracks",
    "foresee": "predict",
    "foreseen": "predicted",
    "foresees": "predicts",
    "surprise": "innovation",
    "stray": "clutter",
    "strays": "clutter",
    "kin": "foreign lights of one kind",
    "attend": "update",
    "attends": "updates",
    "befalls": "happens to",
    "strangers": "other people",
    "vouch": "prove",
    "vouches": "proves",
}
RETIRED_PHRASES = {
    r"small[ _]fry": "clutter",
    r"(image|light)[ _]doors?": "process or process_detections",
    r"\bdoors?\b": "process or process_detections",
    r"slow[ _]states?": "calibration states",
    r"takes?[ _]in\b": "update",
    r"taken[ _]in\b": "updated with",
    r"may be said": "is valid",
    r"cold[ _](starts?|frames?|search(es)?|match(es)?|fix(es)?|poses?|answers?)\b": "acquisition",
    r"warm[ _](starts?|frames?|search(es)?|track(s|ing)?)\b": "tracking",
    r"\ba lock\b(?! on a)|\blocks (hold|on)\b|\blocked track": "a confirmed track",
    r"\bnames? of lights\b": "associations or ids of lights",
    r"\bwrong names?\b": "wrong identities",
    r"\bstrange\b": "unlike a light",
    r"\bstrain\b": "running mean of the innovation",
}


def findings(text: str):
    """Line number, word and what to say instead."""
    for number, line in enumerate(text.splitlines(), 1):
        for word in WORD.findall(line):
            if word.lower() in RETIRED:
                yield number, word, RETIRED[word.lower()]
        for phrase, better in RETIRED_PHRASES.items():
            if found := re.search(phrase, line, re.IGNORECASE):
                yield number, found[0], better


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_retired_word_is_used(path):
    assert [f"line {n}: {word!r}, say {better}" for n, word, better in findings(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(
    "line", ["the spots", "nSpots = 1", "naming_of(x)", "a Belief", "through the light door", "cold start"]
)
def test_a_retired_word_is_found(line):
    assert list(findings(line))


@pytest.mark.parametrize(
    "line", ["named fields", "filename", "skinny", "cold=True", "lumidock warm", "threading.Lock()"]
)
def test_an_ordinary_word_is_left_alone(line):
    assert not list(findings(line))
