"""Run the benches named on the command line, or all; each leaves NAME.md and NAME.json in bench-out."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from bench import images, speed, table1

BENCHES = {"table1": table1, "images": images, "speed": speed}


def main() -> None:
    """Run and print."""
    out = Path("bench-out")
    out.mkdir(exist_ok=True)
    for name in sys.argv[1:] or BENCHES:
        start = time.monotonic()
        content, lines = BENCHES[name].main()
        text = "\n".join(lines)
        (out / f"{name}.md").write_text(text + "\n", encoding="utf-8")
        (out / f"{name}.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        print(f"{text}\n({name}: {time.monotonic() - start:.0f} s)\n", flush=True)


if __name__ == "__main__":
    main()
