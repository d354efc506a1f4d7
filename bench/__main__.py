"""Run the benches named on the command line, or all; each leaves NAME.md and NAME.json in bench-out.

With --readme each table also replaces its own in the README, between <!-- NAME --> and <!-- /NAME -->.
"""

from __future__ import annotations

import json
import re
import sys
import time
from pathlib import Path

from bench import (
    association,
    contact_sheet,
    detection,
    detector_errors,
    dockings,
    images,
    rendering,
    reproduced,
    speed,
    table1,
    visibility,
)

BENCHES = {
    "association": association,
    "table1": table1,
    "images": images,
    "speed": speed,
    "detection": detection,
    "detector-errors": detector_errors,
    "dockings": dockings,
    "visibility": visibility,
    "rendering": rendering,
    "reproduced": reproduced,
    "contact-sheet": contact_sheet,
}


def main() -> None:
    """Run and print."""
    out = Path("bench-out")
    out.mkdir(exist_ok=True)
    names = [name for name in sys.argv[1:] if name != "--readme"]
    for name in names or BENCHES:
        start = time.monotonic()
        content, lines = BENCHES[name].main()
        text = "\n".join(lines)
        (out / f"{name}.md").write_text(text + "\n", encoding="utf-8")
        (out / f"{name}.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        if "--readme" in sys.argv:
            _into_readme(name, text)
        print(f"{text}\n({name}: {time.monotonic() - start:.0f} s)\n", flush=True)


def _into_readme(name: str, text: str) -> None:
    """Replace one table of the README."""
    readme = Path("README.md")
    between = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    readme.write_text(between.sub(lambda m: f"{m[1]}{text}\n{m[2]}", readme.read_text()), encoding="utf-8")


if __name__ == "__main__":
    main()
