"""Run the benches named on the command line, or all; each leaves NAME.md and NAME.json in bench-out.

With --docs each table also replaces its own in the documentation, between <!-- NAME --> and <!-- /NAME -->.
"""

from __future__ import annotations

import json
import re
import sys
import time
from pathlib import Path

from bench import (
    acquisition,
    acquisition_time,
    aiding,
    association,
    bank,
    closed_loop,
    commands,
    configuration,
    console,
    console_film,
    console_memory,
    console_pictures,
    contact_sheet,
    detection,
    detector_constants,
    detector_errors,
    dockings,
    docks,
    faults,
    gallery,
    images,
    lamp_weights,
    learned_matcher,
    nominal,
    ports,
    rendering,
    reproduced,
    speed,
    surveys,
    table1,
    visibility,
)

BENCHES = {
    "acquisition": acquisition,
    "acquisition-time": acquisition_time,
    "bank": bank,
    "nominal": nominal,
    "ports": ports,
    "association": association,
    "closed-loop": closed_loop,
    "table1": table1,
    "images": images,
    "speed": speed,
    "detection": detection,
    "detector-errors": detector_errors,
    "detector-constants": detector_constants,
    "lamp-weights": lamp_weights,
    "learned-matcher": learned_matcher,
    "aiding": aiding,
    "dockings": dockings,
    "faults": faults,
    "docks": docks,
    "surveys": surveys,
    "gallery": gallery,
    "visibility": visibility,
    "rendering": rendering,
    "contact-sheet": contact_sheet,
    "configuration": configuration,
    "commands": commands,
    "console": console,
    "console-film": console_film,
    "console-memory": console_memory,
    "console-pictures": console_pictures,
    **reproduced.TABLES,
}


def main() -> None:
    """Run and print."""
    out = Path("bench-out")
    out.mkdir(exist_ok=True)
    names = [name for name in sys.argv[1:] if name != "--docs"]
    for name in names or BENCHES:
        start = time.monotonic()
        content, lines = BENCHES[name].main()
        text = "\n".join(lines)
        (out / f"{name}.md").write_text(text + "\n", encoding="utf-8")
        (out / f"{name}.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        if "--docs" in sys.argv:
            into_docs(name, text)
        print(f"{text}\n({name}: {time.monotonic() - start:.0f} s)\n", flush=True)


def between_marks(name: str) -> re.Pattern[str]:
    """The place of one table in a page; its groups are the marks before and after."""
    return re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)


def into_docs(name: str, text: str) -> None:
    """Replace one table wherever the documentation shows it. Raises: SystemExit where no page does."""
    found = False
    for page in (Path("README.md"), *sorted(Path("docs").glob("*.md"))):
        before = page.read_text(encoding="utf-8")
        after, count = between_marks(name).subn(lambda m: f"{m[1]}\n{text}\n\n{m[2]}", before)
        found |= count > 0
        if after != before:
            page.write_text(after, encoding="utf-8")
    if not found:
        raise SystemExit(f"{name}: no page of the documentation has the mark <!-- {name} -->")


if __name__ == "__main__":
    main()
