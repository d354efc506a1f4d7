"""Settings tried on the last seconds of a live camera, beside the settings in use; guidance keeps its own."""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from lumidock.app.console.frame_view import trust
from lumidock.app.console.jobs import Job, Jobs
from lumidock.app.console.limits import Choice
from lumidock.app.console.live import LiveView
from lumidock.app.console.stretch import write_stretch
from lumidock.app.console.tuning import profile_text
from lumidock.errors import InputError
from lumidock.streams.replay import read_fixes


def preview(jobs: Jobs, live: LiveView, method: str, in_use: Choice, proposed: Choice) -> Job:
    """Run the frames that were kept with what is in use and with what is proposed; the job gives both, frame by frame.

    Raises: InputError where no frame has been kept yet.
    """
    frames = live.kept()
    if not frames:
        raise InputError("no frame has been kept yet; wait some seconds with this tab open")

    choices = {"in_use": in_use, "proposed": proposed}

    def work(job: Job) -> dict[str, Any]:
        with tempfile.TemporaryDirectory(dir=in_use.files.scratch) as scratch:
            folder = Path(scratch)
            write_stretch(frames, folder / "sequence")
            found = {name: _run(job, folder / name, choice) for name, choice in choices.items()}
            return found | {"seconds": round((frames[-1].t_ns - frames[0].t_ns) * 1e-9, 2)}

    def _run(job: Job, out: Path, choice: Choice) -> dict[str, Any]:
        settings, files = out.with_suffix(".yaml"), choice.files
        settings.write_text(profile_text(choice.config, "of a preview"), encoding="utf-8")
        words = ["run", str(out.with_name("sequence")), "--station", str(files.station), "--camera", str(files.camera)]
        words += ["--method", method, "--config", str(settings), "--out", str(out), "--json"]
        job.command(words)
        fixes = [fix for fix, _, _ in read_fixes(out, live.scene.station.ids)]
        return {
            "trust": "".join(trust(fix)[0] for fix in fixes),
            "reasons": dict(Counter(fix.reason for fix in fixes if fix.reason)),
            "detections": sum(fix.n_seen for fix in fixes),
            "used": sum(fix.n_used for fix in fixes),
        }

    return jobs.start("preview", work)
