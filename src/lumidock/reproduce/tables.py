"""The tables of a page in files: Markdown together, and each as CSV and as LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from lumidock.evaluation.campaign import write_whole
from lumidock.report import page
from lumidock.report.page import PageSection, Table

_ESCAPED = {c: f"\\{c}" for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "≈": r"$\approx$",
    "✓": r"\checkmark{}",
    "✗": r"$\times$",
}


def write_tables(sections: Sequence[tuple[str, PageSection]], out: Path) -> None:
    """Write tables.md, and tables/SECTION-N.csv and .tex, into the folder of a reproduction."""
    write_whole(out / "tables.md", "\n".join(_markdown(section) for _, section in sections if any(_tables(section))))
    (out / "tables").mkdir(exist_ok=True)
    for name, section in sections:
        for number, table in enumerate(_tables(section), start=1):
            write_whole(out / "tables" / f"{name}-{number}.csv", as_csv(table))
            write_whole(out / "tables" / f"{name}-{number}.tex", latex(table))


def _tables(section: PageSection) -> Iterator[Table]:
    return (item for item in section.items if isinstance(item, Table))


def _markdown(section: PageSection) -> str:
    return "\n".join([f"## {section.title}\n", *(page.markdown(table) for table in _tables(section))])


def as_csv(table: Table) -> str:
    """A table as CSV, head first."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([table.head, *table.rows])
    return out.getvalue()


def latex(table: Table) -> str:
    r"""A table as a LaTeX `table`; \checkmark needs the package amssymb."""
    columns = "l" + "r" * (len(table.head) - 1)
    rows = [" & ".join(map(_escaped, row)) + r" \\" for row in (table.head, *table.rows)]
    body = [rows[0], r"\hline", *rows[1:]]
    begin = [r"\begin{table}", rf"\caption{{{_escaped(table.caption)}}}", rf"\begin{{tabular}}{{{columns}}}", r"\hline"]
    return "\n".join([*begin, *body, r"\hline", r"\end{tabular}", r"\end{table}"]) + "\n"


def _escaped(text: str) -> str:
    return "".join(_ESCAPED.get(character, character) for character in text)
