"""`lumidock inspect`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from lumidock.cli.progress import progress_bar
from lumidock.cli.shared import (
    AsJson,
    AsStored,
    Bits,
    CameraName,
    CameraOption,
    DelayMs,
    Fps,
    InfoTopic,
    Topic,
    Trusted,
    app,
    calibration_of,
    example,
    open_any,
)
from lumidock.errors import extra
from lumidock.streams.source import Reading

_OF_A_CAMERA = 100  # frames, which has no end


@app.command(
    "inspect", epilog=example("lumidock inspect dive.mcap", "lumidock inspect SEQ --camera camera.yaml --json")
)
def _inspect(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Sequence or image folder, video, bag, or a camera's address.")
    ],
    camera: CameraOption = None,
    topic: Topic = None,
    info_topic: InfoTopic = None,
    bits: Bits = 16,
    fps: Fps = None,
    as_stored: AsStored = False,
    delay_ms: DelayMs = 0.0,
    camera_name: CameraName = None,
    trust_calibration: Trusted = False,
    frames: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Look at so many frames; 100 of a camera.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show sizes, rates, gaps and exposure of SOURCE."""
    from lumidock.streams.inspection import inspect

    reading = Reading(
        fps, topic, info_topic, bits, as_stored=as_stored, trusted=trust_calibration, follow_calibration=False
    )
    opened = open_any(source, reading, delay_ms=delay_ms)
    most = frames or (_OF_A_CAMERA if opened.live else None)
    known = camera is not None or opened.camera is not None or opened.calibration is not None
    calibration = calibration_of(camera, opened, name=camera_name, trusted=trust_calibration) if known else None
    with progress_bar("inspect") as progress:
        result = inspect(opened, calibration.camera if calibration else None, most=most, progress=progress)
    result["notes"] = [*opened.notes, *(calibration.warnings if calibration else ())]
    result["no_calibration"] = opened.no_calibration if calibration is None else ""
    if opened.kind == "bag":
        with extra("bag"):
            from lumidock.streams.bag import topics_of
        result["topics"] = [{"name": t.name, "type": t.type, "messages": t.count} for t in topics_of(Path(source))]
    if as_json:
        print(json.dumps(result, indent=1))
    else:
        _print(result)


def _print(result: dict[str, Any]) -> None:
    for topic in result.get("topics", ()):
        print(f"topic       {topic['name']}  {topic['type']}  {topic['messages']} messages")
    print(f"frames      {result['frames']} ({result['kind']})")
    for size in result["sizes"]:
        print(f"size        {size['width']} x {size['height']} {size['encoding']}, {size['frames']} frames")
    if result["unusable"]:
        words = ", ".join(f"{word} {count}" for word, count in result["unusable"].items())
        print(f"unusable    {words}; first: {result['first_problem']}")
    for note in result["notes"]:
        print(f"note        {note}")
    if result["bits"]:
        print(f"bits        pixels use {result['bits']} of 16 bits at most; give --bits {result['bits']}")
    _print_fit(result["calibration"], result["no_calibration"])
    time, exposure = result["time"], result["exposure"]
    if time["rate_hz"] is not None:
        print(f"time        {time['span_s']:.3f} s at {time['rate_hz']:.2f} Hz, jitter {time['jitter_ms']:.2f} ms")
        print(
            f"gaps        {time['gaps']}, longest {time['longest_gap_s']:.3f} s; {time['drops']} frames dropped, "
            f"{time['out_of_order']} out of order"
        )
    if exposure["median_level"] is not None:
        print(f"exposure    median level {exposure['median_level']:.0f}, {100 * exposure['saturated']:.2f} % saturated")


def _print_fit(fit: dict[str, Any] | None, why_none: str) -> None:
    if fit is None:
        print(f"calibration none{': ' if why_none else ''}{why_none}")
    elif fit["frames_of_another_size"]:
        print(
            f"calibration of {fit['width']} x {fit['height']} does NOT fit {fit['frames_of_another_size']} frames; "
            "calibrate at the size that is recorded"
        )
    else:
        print(f"calibration of {fit['width']} x {fit['height']} fits")
