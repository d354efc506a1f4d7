"""What the console answers: its page, the live socket, and JSON for replay, settings and wizards."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from lumidock.app.console.frame_view import scene_view
from lumidock.app.console.guard import SUBPROTOCOL
from lumidock.app.console.jobs import Jobs
from lumidock.app.console.limits import Choice, files_with
from lumidock.app.console.live import RATE_HZ, LiveView
from lumidock.app.console.preview import preview
from lumidock.app.console.replay import Replay
from lumidock.app.console.tuning import changed, load_profile, profile_text, save_profile, settings_view
from lumidock.app.console.wizards import Calibration, Files, board_of, check_dock, save_result, survey_dock
from lumidock.app.reasons import REASONS
from lumidock.config import Config
from lumidock.errors import InputError, LumidockError
from lumidock.methods import method_names

_KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
_MOST_PAGES = 8  # that look on at once
_STALLED_S = 30.0  # until a page that neither asks nor reads gives its place to others
_LOOK_S = 0.5  # within which the board is searched for once: it takes a processor 50 to 200 ms


Body = dict[str, Any]


@dataclass(slots=True)
class Console:
    """What the pages show, and what they may start.

    Either `live` or `replay` is there. `files` hold the station and camera in use, `method` and `config` are those of
    guidance or of the recording; `about` is the line at the head of a profile. `health` is told as JSON to machines.
    """

    files: Files
    method: str
    config: Config
    about: str
    jobs: Jobs = field(default_factory=Jobs)
    live: LiveView | None = None
    replay: Replay | None = None
    health: Callable[[], dict[str, Any]] = lambda: {"ok": True}
    pages: int = 0
    looked_s: float = 0.0
    calibration: Calibration = field(init=False)

    def __post_init__(self) -> None:
        self.calibration = Calibration(self.files)

    def need_live(self) -> LiveView:
        """The live view. Raises: InputError for a recording."""
        if self.live is None:
            raise InputError("a recording is shown, no live camera")
        return self.live

    def need_replay(self) -> Replay:
        """The recording. Raises: InputError where a camera is shown live."""
        if self.replay is None:
            raise InputError("a live camera is shown, no recording")
        return self.replay

    def choice(self, body: Body) -> Choice:
        """The settings and files of a request. Raises: InputError for settings or alert limits that there cannot be."""
        return Choice(changed(self.config, body.get("settings", {})), files_with(self.files, body.get("limits")))

    def close(self) -> None:
        """End all that runs."""
        self.jobs.close()
        if self.replay is not None:
            self.replay.close()


Answer = Callable[[Request], Awaitable[Response]]


def application(console: Console) -> Starlette:
    """The console as an ASGI application; who may ask is for the guard around it."""
    of = _Api(console)
    reading = {
        "/": _page("index.html"),
        "/health.json": of.health,
        "/register_service": of.service,
        "/api/about": of.about,
        "/api/settings": of.settings,
        "/api/recording": of.recording,
        "/api/recording/{variant:int}/{index:int}": of.frame,
        "/api/picture/{index:int}": of.picture,
        "/api/jobs/{number:int}": of.job,
        "/api/jobs/{number:int}/file": of.job_file,
    }
    writing = {
        "/api/rerun": of.rerun,
        "/api/bundle": of.bundle,
        "/api/keep": of.keep,
        "/api/preview": of.preview,
        "/api/profile/text": of.profile_text,
        "/api/profile/save": of.profile_save,
        "/api/profile/load": of.profile_load,
        "/api/check": of.check,
        "/api/board/look": of.board_look,
        "/api/board/restart": of.board_restart,
        "/api/board/solve": of.board_solve,
        "/api/survey": of.survey,
        "/api/save": of.save,
        "/api/limits/save": of.limits_save,
    }
    return Starlette(
        routes=[
            *(Route(path, _told(answer)) for path, answer in reading.items()),
            *(Route(path, _told(answer), methods=["POST"]) for path, answer in writing.items()),
            Route("/static/{name}", _told(_static)),
            WebSocketRoute("/api/live", of.socket),
        ]
    )


def _told(answer: Answer) -> Answer:
    """The same, with what lumidock or the file system refuses told in a line."""

    async def endpoint(request: Request) -> Response:
        try:
            return await answer(request)
        except LumidockError as error:
            return JSONResponse({"error": str(error)}, 400)
        except OSError as error:
            return JSONResponse({"error": f"{error.filename or 'file system'}: {error.strerror or error}"}, 400)

    return endpoint


def _file(name: str) -> Response:
    path = package_files("lumidock") / "app" / "console" / "static" / name
    suffix = Path(name).suffix
    if suffix not in _KINDS or "/" in name or not path.is_file():
        return JSONResponse({"error": f"no file {name[:80]}"}, 404)
    return Response(path.read_bytes(), media_type=_KINDS[suffix])


def _page(name: str) -> Answer:
    async def page(_request: Request) -> Response:
        return _file(name)

    return page


async def _static(request: Request) -> Response:
    return _file(request.path_params["name"])


async def _body(request: Request) -> Body:
    """The JSON object of a request. Raises: InputError for anything else."""
    try:
        content = json.loads(await request.body() or b"{}")
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise InputError("wanted a JSON object")
    return content


class _Api:
    """One method for each address; what takes longer than a frame leaves the event loop."""

    def __init__(self, console: Console) -> None:
        self._console = console

    async def health(self, _request: Request) -> Response:
        return JSONResponse(self._console.health())

    async def service(self, _request: Request) -> Response:
        """What BlueOS asks every port for, to list its services."""
        return JSONResponse(
            {
                "name": "lumidock",
                "description": "Where the vehicle is relative to its dock",
                "icon": "mdi-lighthouse",
                "company": "lumidock",
                "version": version("lumidock"),
                "webpage": "",
                "api": "/health.json",
                "new_page": True,
            }
        )

    async def about(self, request: Request) -> Response:
        it = self._console
        scene = it.live.scene if it.live is not None else it.need_replay().recording.scene
        del request
        return JSONResponse(
            scene_view(scene)
            | {
                "mode": "live" if it.live is not None else "replay",
                "version": version("lumidock"),
                "method": it.method,
                "methods": list(method_names()),
                "about": it.about,
                "camera_file": str(it.files.camera),
                "station_file": str(it.files.station),
                "reasons": {word: [reason.meaning, reason.remedy] for word, reason in REASONS.items()},
            }
        )

    async def settings(self, _request: Request) -> Response:
        return JSONResponse(settings_view(self._console.config))

    # Live

    async def socket(self, socket: WebSocket) -> None:
        """One message for each one asked for, at most ten a second; the page says which it saw last."""
        live = self._console.live
        if live is None or self._console.pages >= _MOST_PAGES:
            await socket.close(1013, "a recording" if live is None else "too many pages look on")
            return
        await socket.accept(SUBPROTOCOL if SUBPROTOCOL in socket.scope["subprotocols"] else None)
        news, loop = asyncio.Event(), asyncio.get_running_loop()

        def tell() -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(news.set)

        end = live.subscribe(tell)
        self._console.pages += 1
        try:
            await _answer_all(socket, live, news)
        except (asyncio.TimeoutError, ValueError):  # it stalls, or sent no number
            with suppress(RuntimeError):
                await socket.close(1008)
        except (WebSocketDisconnect, RuntimeError):  # it went away
            pass
        finally:
            self._console.pages -= 1
            end()

    async def keep(self, _request: Request) -> Response:
        live = self._console.need_live()
        live.ask_to_keep()
        frames = live.kept()
        seconds = (frames[-1].t_ns - frames[0].t_ns) * 1e-9 if frames else 0.0
        return JSONResponse({"frames": len(frames), "seconds": round(seconds, 1)})

    async def preview(self, request: Request) -> Response:
        it = self._console
        in_use, proposed = Choice(it.config, it.files), it.choice(await _body(request))
        return JSONResponse(preview(it.jobs, it.need_live(), it.method, in_use, proposed).view())

    # Replay

    async def recording(self, _request: Request) -> Response:
        return JSONResponse(await asyncio.to_thread(self._console.need_replay().view))

    async def frame(self, request: Request) -> Response:
        variant, index = request.path_params["variant"], request.path_params["index"]
        return JSONResponse(self._console.need_replay().frame(variant, index))

    async def picture(self, request: Request) -> Response:
        data = self._console.need_replay().picture(request.path_params["index"])
        return Response(data, media_type="image/jpeg") if data else Response(status_code=204)

    async def rerun(self, request: Request) -> Response:
        body, it = await _body(request), self._console
        method, stretch = str(body.get("method", it.method)), _stretch(body)
        label = str(body.get("label", method))[:80]
        return JSONResponse(it.need_replay().rerun(method, it.choice(body), label, stretch).view())

    async def bundle(self, request: Request) -> Response:
        body = await _body(request)
        stretch, bookmarks = _stretch(body), body.get("bookmarks", [])
        if stretch is None or not isinstance(bookmarks, list) or not all(isinstance(k, int) for k in bookmarks):
            raise InputError("bundle: wanted first, last and a list of bookmarked frames")
        notes, variant = str(body.get("notes", ""))[:4000], body.get("variant", 0)
        if not isinstance(variant, int):
            raise InputError("bundle: wanted the number of a variant")
        return JSONResponse(self._console.need_replay().bundle(variant, stretch, bookmarks[:1000], notes).view())

    async def job(self, request: Request) -> Response:
        return JSONResponse(self._console.jobs.get(request.path_params["number"]).view())

    async def job_file(self, request: Request) -> Response:
        job = self._console.jobs.get(request.path_params["number"])
        if job.title != "bundle" or job.state != "done":
            raise InputError(f"job {job.number} made no file")
        return FileResponse(job.result["file"], media_type="application/zip", filename="lumidock-bundle.zip")

    # Settings and profiles

    async def profile_text(self, request: Request) -> Response:
        return JSONResponse({"text": await self._profile(request)})

    async def profile_save(self, request: Request) -> Response:
        body = await _body(request)
        path = _path(body)
        save_profile(await self._profile(request), path, replace=body.get("replace") is True)
        return JSONResponse({"saved": str(path)})

    async def limits_save(self, request: Request) -> Response:
        body, it = await _body(request), self._console
        if body.get("limits") is None:
            raise InputError("alert limits: wanted a list")
        path, station = _path(body), files_with(it.files, body["limits"]).station
        save_profile(station.read_text(encoding="utf-8"), path, replace=body.get("replace") is True)
        return JSONResponse({"saved": str(path)})

    async def profile_load(self, request: Request) -> Response:
        return JSONResponse(settings_view(load_profile(_path(await _body(request)))))

    async def _profile(self, request: Request) -> str:
        body, it = await _body(request), self._console
        vehicle = str(body.get("vehicle", "")).strip()[:64]
        about = f"{it.about}{f', vehicle {vehicle}' if vehicle else ''}"
        return profile_text(changed(it.config, body.get("settings", {})), about)

    # Wizards

    async def check(self, _request: Request) -> Response:
        return JSONResponse(check_dock(self._console.jobs, self._console.files).view())

    async def board_look(self, request: Request) -> Response:
        body, it = await _body(request), self._console
        board, frame = board_of(body), it.need_live().newest()
        if frame is None:
            raise InputError("there is no picture yet")
        take, now_s = body.get("take") is True, time.monotonic()
        if not take and now_s - it.looked_s < _LOOK_S:
            raise InputError("asked too often")
        it.looked_s = now_s
        return JSONResponse(await asyncio.to_thread(it.calibration.look, board, frame, take=take))

    async def board_restart(self, _request: Request) -> Response:
        self._console.calibration.restart()
        return JSONResponse({})

    async def board_solve(self, request: Request) -> Response:
        body, it = await _body(request), self._console
        source = None
        if it.replay is not None:
            recorded = it.replay.recording.source
            if recorded is None:
                raise InputError("the frames of this run are not at hand; give --source")
            source = str(recorded.path)
        model = str(body.get("model", "plumb_bob"))
        return JSONResponse(it.calibration.solve(it.jobs, board_of(body), model, source).view())

    async def survey(self, request: Request) -> Response:
        it, body = self._console, await _body(request)
        return JSONResponse(survey_dock(it.jobs, it.files, it.need_replay().run_folder, body).view())

    async def save(self, request: Request) -> Response:
        body = await _body(request)
        path = _path(body)
        save_result(self._console.files, str(body.get("kind")), path, replace=body.get("replace") is True)
        return JSONResponse({"saved": str(path)})


async def _answer_all(socket: WebSocket, live: LiveView, news: asyncio.Event) -> None:
    sent_s = 0.0
    while True:
        seen = int(await asyncio.wait_for(socket.receive_text(), _STALLED_S))
        while live.number <= seen:
            news.clear()
            if live.number <= seen:
                await news.wait()
        await asyncio.sleep(max(0.0, sent_s + 1.0 / RATE_HZ - time.monotonic()))
        sent_s = time.monotonic()
        _, message = await asyncio.to_thread(live.message)
        await asyncio.wait_for(socket.send_bytes(message), _STALLED_S)


def _path(body: Body) -> Path:
    path = body.get("path")
    if not isinstance(path, str) or not path.strip() or "\0" in path:
        raise InputError("wanted the path of a file")
    return Path(path.strip()).expanduser()


def _stretch(body: Body) -> tuple[int, int] | None:
    """First and last frame of a request; None for all of them. Raises: InputError for anything but two numbers."""
    first, last = body.get("first"), body.get("last")
    if first is None and last is None:
        return None
    if not isinstance(first, int) or not isinstance(last, int):
        raise InputError("wanted the numbers of the first and the last frame")
    return first, last
