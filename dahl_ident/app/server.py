"""The web server: pages for the files of a folder, reachable from this machine only."""

from __future__ import annotations

import hmac
import json
import math
import secrets
import shlex
import subprocess
import sys
import webbrowser
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import uvicorn
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from dahl_ident import reporting
from dahl_ident.app import commands
from dahl_ident.app.commands import JobStep, laws, loop_picture
from dahl_ident.app.preview import EMPTY_PREVIEW
from dahl_ident.app.work import Jobs, Work, new_folder, output
from dahl_ident.data.storage import save_frame
from dahl_ident.errors import DahlIdentError
from dahl_ident.results import FitResult

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LIMIT = 2_000_000_000
"""Largest size of one upload, bytes."""
_READ_SECONDS = 600  # time limit of reading files for the preview
_DOWNLOADS = {
    "report.html": "Report",
    "report.pdf": "Report, PDF",
    "fit.json": "Fit, JSON",
    "points.csv": "Points, CSV",
    "plan.csv": "Plan, CSV",
    "waveform.csv": "Waveform, CSV",
}
_EXPORTS = {
    "latex": "LaTeX",
    "c": "C",
    "matlab": "MATLAB",
    "modelica": "Modelica",
    "urdf": "URDF",
    "mujoco": "MuJoCo",
}
_REPORT_POLICY = (
    "sandbox allow-scripts allow-modals allow-downloads; default-src 'none'; img-src data:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
_HERE = Path(__file__).parent
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Guard:
    """Refuses requests that lack the token, name another host, or come from other pages.

    The token is first in the address, then in a cookie that requests from other sites do not
    carry; `limit` is the largest body of a request, in bytes.
    """

    def __init__(self, app: ASGIApp, token: str, port: int, limit: int) -> None:
        self._app = app
        self._token = token.encode()
        self._limit = limit
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
        self._cookie = f"dahl_ident_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it on."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if scope["type"] == "http":
            early = self._early_response(Request(scope))
            await (early or self._app)(scope, receive, send_with_headers)
        else:
            await self._app(scope, receive, send)

    def _early_response(self, request: Request) -> Response | None:
        """Return the response to a request that is not passed on, None for others."""
        if request.headers.get("host") not in self._hosts:
            return PlainTextResponse("This server answers requests to 127.0.0.1 only.", 421)
        origin = request.headers.get("origin")
        is_read = request.method in ("GET", "HEAD")
        if (origin or not is_read) and origin not in {f"http://{host}" for host in self._hosts}:
            return PlainTextResponse("The request comes from another page.", 403)
        if self._is_token(request.query_params.get("token", "")):
            response = RedirectResponse(request.url.path, 303)
            token = self._token.decode()
            response.set_cookie(self._cookie, token, httponly=True, samesite="strict")
            return response
        if not self._is_token(request.cookies.get(self._cookie, "")):
            text = "Open the address with its token, as the terminal printed it."
            return PlainTextResponse(text, 403)
        size = request.headers.get("content-length", "0" if is_read else "")
        if not size.isdecimal():
            return PlainTextResponse("The request does not say how long it is.", 411)
        if int(size) > self._limit:
            text = f"The files are larger than {self._limit / 1e6:.0f} MB; send fewer at once."
            return PlainTextResponse(text, 413)
        return None

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._token)


class App:
    """The pages; `root` holds a folder for each piece of work, `laws` go to every command."""

    def __init__(self, root: Path, laws: tuple[Path, ...] = ()) -> None:
        self.root, self.jobs = root, Jobs()
        self.laws = [str(path.resolve()) for path in laws]
        self._templates = Environment(
            loader=FileSystemLoader(_HERE / "templates"),
            autoescape=select_autoescape(default=True, default_for_string=True),
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )

    def routes(self) -> list[Route | Mount]:
        """Return the handler of every address."""
        get, post = partial(Route, methods=["GET"]), partial(Route, methods=["POST"])
        return [
            get("/", self.start),
            post("/", self.upload),
            get("/laws/{kind}.svg", self.law),
            get("/static/page.{ending}", self.report_asset),
            Mount("/static", StaticFiles(directory=_HERE / "static")),
            get("/{work}", self.data),
            post("/{work}", self.save_data),
            post("/{work}/files", self.upload),
            get("/{work}/model", self.model),
            post("/{work}/model", self.save_model),
            post("/{work}/commands", self.equivalent_commands),
            get("/{work}/run-{run:int}", self.run),
            get("/{work}/run-{run:int}/state", self.state),
            post("/{work}/run-{run:int}/{what:str}", self.act),
            get("/{work}/run-{run:int}/file/{path:path}", self.download),
            get("/{work}/run-{run:int}/export/{to}", self.export),
        ]

    def _page(self, name: str, status: int = 200, **values: Any) -> Response:
        text = self._templates.get_template(f"{name}.html").render(now=name, **values)
        return HTMLResponse(text, status)

    def _work(self, request: Request) -> Work:
        work = Work.named(self.root, request.path_params["work"])
        if work is None:
            raise HTTPException(404, "There is no such work in this folder.")
        return work

    def _run(self, request: Request) -> tuple[Work, Path]:
        work = self._work(request)
        folder = work.folder / f"run-{request.path_params['run']}"
        if not (folder / "job.json").exists():
            raise HTTPException(404, "There is no such run.")
        return work, folder

    async def start(self, request: Request) -> Response:
        """Show earlier work, and where to drop files."""
        works = [(work, work.state) for work in Work.all(self.root)]
        return self._page("start", works=works, root=self.root)

    async def upload(self, request: Request) -> Response:
        """Store files, in a new piece of work or in an existing one."""
        async with request.form(max_files=500) as form:
            files = [f for f in form.getlist("files") if not isinstance(f, str) and f.filename]
            if not files:
                raise HTTPException(400, "No file was chosen; go back and choose one or more.")
            exists = "work" in request.path_params
            work = self._work(request) if exists else Work.create(self.root)
            for file in files:
                await run_in_threadpool(work.add, file.filename or "file", file.file)
        return _redirect(f"/{work.name}")

    async def data(self, request: Request) -> Response:
        """Show the channels of the files, and the form that says what each one is."""
        work = self._work(request)
        preview = await run_in_threadpool(self._preview, work)
        return self._page(
            "data",
            work=work,
            state=work.state,
            found=preview,
            roles=commands.ROLES,
            fields=commands.FIELDS,
        )

    def _preview(self, work: Work) -> dict[str, Any]:
        child = subprocess.run(
            [sys.executable, "-m", "dahl_ident.app.preview"],
            cwd=work.folder,
            check=False,
            input=json.dumps(work.state).encode(),
            capture_output=True,
            timeout=_READ_SECONDS,
        )
        if child.returncode:
            last = child.stderr.decode(errors="replace").strip().splitlines()[-1:]
            error = " ".join(["The files could not be read.", *last])
            return {**EMPTY_PREVIEW, "error": error}
        preview: dict[str, Any] = json.loads(child.stdout)
        for name in ("error", "summary"):
            preview[name] = work.with_uploaded_names(preview[name])
        preview["notes"] = [work.with_uploaded_names(note) for note in preview["notes"]]
        return preview

    async def save_data(self, request: Request) -> Response:
        """Store what the channels are; then continue, or show the preview again."""
        work, form = self._work(request), await _form(request)
        work.write("columns.toml", commands.columns_toml(form))
        names = (
            "kind",
            *commands.TABLE_OPTIONS,
            *commands.RECORD_OPTIONS,
            *commands.COMMON_OPTIONS,
        )
        reading = {name: form.get(name, "") for name in names}
        if form.get("next"):  # the user has confirmed the detected kind
            reading["kind"] = reading["kind"] or form.get("found", "")
        work.save(reading=reading, confirmed="next" in form)
        return _redirect(f"/{work.name}/model" if form.get("next") else f"/{work.name}")

    async def model(self, request: Request) -> Response:
        """Show the form for the model and what is known of the device."""
        work = self._work(request)
        known_laws = await run_in_threadpool(laws, self.laws)
        return self._page("model", work=work, state=work.state, laws=known_laws)

    async def save_model(self, request: Request) -> Response:
        """Store that form, and start a run."""
        work, form = self._work(request), await _form(request)
        work.save(**_knowledge(form))
        work.write("report.toml", commands.report_toml(form))
        folder = work.new_run()
        steps, program = self._commands(work, work.state, folder.name)
        (folder / "program.py").write_text(program, "utf-8")
        self.jobs.start(folder, steps, work.folder)
        return _redirect(f"/{work.name}/{folder.name}")

    def _commands(self, work: Work, state: dict[str, Any], run: str) -> tuple[list[JobStep], str]:
        state["laws"] = self.laws
        metadata = bool(commands.report_toml(state["report"]))
        steps = commands.fit_steps(state, work.folder, run, metadata=metadata)
        return steps, commands.as_python(state, work.folder, metadata=metadata)

    async def equivalent_commands(self, request: Request) -> Response:
        """Return the form as the equivalent commands and Python program, without running them."""
        work, form = self._work(request), await _form(request)
        run = f"run-{1 + len(work.runs())}"
        steps, program = self._commands(work, {**work.state, **_knowledge(form)}, run)
        return JSONResponse({"commands": _typed(steps), "program": program})

    async def run(self, request: Request) -> Response:
        """Show the progress of a run, and its result."""
        work, folder = self._run(request)
        job = self.jobs.state(folder)
        page = folder / "report.html"
        report = page.read_text("utf-8") if page.exists() else ""
        parts = []
        for part in sorted(folder.glob("*-[0-9]*"), key=lambda p: p.stat().st_mtime):
            state = self.jobs.state(part)
            text = work.with_uploaded_names(output(part, len(state["steps"]) - 1))
            parts.append((part.name, state, text, self._files(part)))
        return self._page(
            "run",
            work=work,
            state=work.state,
            folder=folder,
            job=job,
            parts=parts,
            report=report.partition("<main>")[2].partition("</main>")[0],
            typed=_typed([JobStep(step["title"], tuple(step["words"])) for step in job["steps"]]),
            program=(folder / "program.py").read_text("utf-8"),
            files=self._files(folder),
            failed=work.with_uploaded_names(job["error"]),
            exports=_EXPORTS,
            is_table=_is_table(folder),
            busy=self.jobs.is_running(folder),
        )

    def _files(self, folder: Path) -> list[tuple[str, str]]:
        return [
            (name, text)
            for name, text in _DOWNLOADS.items()
            if (folder / name).exists() or (name == "points.csv" and _is_table(folder))
        ]

    async def state(self, request: Request) -> Response:
        """Return the progress of a run, for the page's script."""
        _, folder = self._run(request)
        job, left = self.jobs.state(folder), ""
        if job["left"] is not None:
            left = f", about {math.ceil(job['left'])} s left"
        title = job["steps"][min(job["step"], len(job["steps"]) - 1)]["title"]
        at = f"step {job['step'] + 1} of {len(job['steps'])}"
        text = f"{title}: {at}, {job['seconds']:.0f} s{left}"
        return JSONResponse({"busy": self.jobs.is_running(folder), "text": text})

    async def act(self, request: Request) -> Response:
        """Cancel a run, or start a comparison or a plan from its fit."""
        work, folder = self._run(request)
        what, form = request.path_params["what"], await _form(request)
        if what == "cancel":
            for part in (folder, *folder.glob("*-[0-9]*")):
                self.jobs.cancel(part)
        elif what in ("compare", "plan") and not self.jobs.is_running(folder):
            part = new_folder(folder, what)
            target = f"{folder.name}/{part.name}"
            step = (
                commands.plan_step(folder.name, form, target, self.laws)
                if what == "plan"
                else commands.compare_step(self.jobs.state(folder)["steps"])
            )
            self.jobs.start(part, [step], work.folder)
        return _redirect(f"/{work.name}/{folder.name}")

    async def download(self, request: Request) -> Response:
        """Return a file that the jobs of a run have written."""
        work, folder = self._run(request)
        wanted = request.path_params["path"]
        points = folder / "points.csv"
        if wanted == points.name and _is_table(folder) and not points.exists():
            fit = await run_in_threadpool(FitResult.load, folder / "fit.json")
            save_frame(fit.data.to_frame(), points)
        files = {str(path.relative_to(folder)): path for path in folder.rglob("*")}
        path = files.get(wanted)  # never a path outside the folder
        if (
            path is None
            or not path.is_file()
            or path.suffix not in (".html", ".pdf", ".json", ".csv", ".png")
        ):
            raise HTTPException(404, "There is no such file in this run.")
        if path.suffix == ".html":  # its styles and scripts are inline
            return FileResponse(path, headers={"Content-Security-Policy": _REPORT_POLICY})
        name = None if path.suffix == ".png" else f"{Path(work.state['title']).stem}_{path.name}"
        return FileResponse(path, filename=name)

    async def export(self, request: Request) -> Response:
        """Return the model as another program reads it."""
        _, folder = self._run(request)
        to = request.path_params["to"]
        if to not in _EXPORTS:
            raise HTTPException(404, "There is no such format.")
        text = await run_in_threadpool(lambda: FitResult.load(folder / "fit.json").export(to))
        headers = {"Content-Disposition": f'attachment; filename="friction_{to}.txt"'}
        return Response(str(text), headers=headers, media_type="text/plain")

    async def report_asset(self, request: Request) -> Response:
        """Return the style sheet or the script of reports, which the pages use as well."""
        name = f"page.{'js' if request.path_params['ending'] == 'js' else 'css'}"
        return FileResponse(Path(reporting.__file__).with_name(name))

    async def law(self, request: Request) -> Response:
        """Return the picture of a law's loop."""
        text = await run_in_threadpool(loop_picture, request.path_params["kind"])
        if text is None:
            raise HTTPException(404, "There is no picture of this law.")
        return Response(text, media_type="image/svg+xml")

    async def failed(self, request: Request, exc: Exception) -> Response:
        """Show an error as a page."""
        status = exc.status_code if isinstance(exc, HTTPException) else 400
        text = exc.detail if isinstance(exc, HTTPException) else str(exc)
        page = self._templates.get_template("error.html").render(error=text)
        return HTMLResponse(page, status)


def _knowledge(form: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Return the entries of the model form as the state stores them."""
    model = {name: form.get(name, "") for name in ("law", "known", "play")}
    for name in commands.LINEAR:
        model |= {name: form.get(name, "none"), f"{name}_value": form.get(f"{name}_value", "")}
    prefixes = ("meta_", "force_", "displacement_", "delay_")
    return {"model": model, "report": {n: t for n, t in form.items() if n.startswith(prefixes)}}


def _typed(steps: Sequence[JobStep]) -> str:
    """Return commands as typed in a terminal."""
    return "".join(f"{shlex.join(('dahl-ident', *step.words))}\n" for step in steps)


def _redirect(place: str) -> Response:
    return RedirectResponse(place, status_code=303)


async def _form(request: Request) -> dict[str, str]:
    form = await request.form(max_fields=5000)
    return {name: value for name, value in form.items() if isinstance(value, str)}


def _is_table(folder: Path) -> bool:
    """Return whether a run fitted a table, whose model can be compared with others."""
    saved = folder / "fit.json"
    head = saved.read_text("utf-8")[:200] if saved.exists() else ""
    return '"schema": "dahl_ident.fit_result"' in head


def application(
    root: Path, token: str, port: int, laws: tuple[Path, ...] = (), limit: int = LIMIT
) -> tuple[Starlette, Jobs]:
    """Return the server's application, and its jobs."""
    app = App(root, laws)
    errors: Mapping[Any, Any] = {HTTPException: app.failed, DahlIdentError: app.failed}
    guard = Middleware(Guard, token=token, port=port, limit=limit)
    return Starlette(routes=app.routes(), middleware=[guard], exception_handlers=errors), app.jobs


def serve(root: Path, *, port: int, laws: tuple[Path, ...] = (), browser: bool = True) -> None:
    """Serve the pages until interrupted; port 0 takes a free one."""
    import socket

    listening = socket.create_server(("127.0.0.1", port))
    port = listening.getsockname()[1]
    token = secrets.token_urlsafe(24)
    app, jobs = application(root, token, port, laws)
    address = f"http://127.0.0.1:{port}/?token={token}"
    sys.stdout.write(f"{address}\nwork is kept in {root.resolve()}; Ctrl-C ends the server\n")
    sys.stdout.flush()
    if browser:
        webbrowser.open(address)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False))
    try:
        server.run(sockets=[listening])
    except KeyboardInterrupt:
        pass
    finally:
        jobs.stop()
