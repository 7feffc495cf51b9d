"""The web application: one page, and what it asks for. What is slow runs in threads: no page waits for another."""

from __future__ import annotations

import asyncio
import secrets
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from importlib.resources import files
from math import inf
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import parse_qsl

from fastapi import Body, FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from pydantic import AfterValidator
from starlette.exceptions import HTTPException

from envs.colors import COLORS
from experiments.play.links import Link, Refused
from experiments.play.session import Session, heard
from experiments.play.worlds import Choice
from planning import GroundingError
from textocvp import WorldModel
from textocvp.film_page import with_films

LONGEST_TEXT = 600  # characters of a sentence, and of what is answered to a wrong one
LARGEST_PICTURE = 20 * 2**20  # bytes of an upload
IDLE_SECONDS = 300.0  # a page says something every minute; one that is silent for longer is closed
# Nothing of another host is ever asked for.
POLICY = "default-src 'self' data:; script-src 'unsafe-inline'; style-src 'unsafe-inline'; base-uri 'none'"
MEDIA = {"gif": "image/gif", "mp4": "video/mp4", "png": "image/png", "html": "text/html"}


def _as_text(said: str) -> str:
    """Half a character, which JSON can hold, can be neither read nor sent back."""
    try:
        said.encode()
    except UnicodeEncodeError:
        raise ValueError("it holds half a character") from None
    return said


def _short(said: str) -> str:
    if len(said) > LONGEST_TEXT:
        raise ValueError(f"it has {len(said)} characters, and at most {LONGEST_TEXT} are read")
    return said


Text = Annotated[str, AfterValidator(_as_text)]
Said = Annotated[Text, Body(embed=True)]
Sentence = Annotated[Text, AfterValidator(_short)]
Number = Annotated[float, Body(embed=True)]


class Closed(Exception):
    """A page asks whose session has ended."""


@dataclass
class Sessions:
    """The open pages, at most `most`."""

    make: Callable[[Link], Session]
    most: int
    idle_seconds: float = IDLE_SECONDS
    open: dict[str, Session] = field(default_factory=dict)
    heard_of: dict[str, float] = field(default_factory=dict)  # when each last said something
    left: list[Session] = field(default_factory=list)  # still busy in their threads when the server ended
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, link: Link) -> tuple[str, Session]:
        """A new page. Others do not wait while its scene is built, which many acts may make long."""
        self.sweep()
        name = secrets.token_urlsafe(12)
        with self.lock:
            if len(self.heard_of) >= self.most:
                raise Refused(f"no more pages may be open than {self.most} (--most-pages {self.most}); close one")
            self.heard_of[name] = inf  # which keeps its place
        try:
            session = self.make(link)
        except BaseException:
            self.close(name)
            raise
        with self.lock:
            self.open[name], self.heard_of[name] = session, time.monotonic()
        return name, session

    def get(self, name: str) -> Session:
        """An open page; Closed for one that is not."""
        with self.lock:
            if (session := self.open.get(name)) is None:
                raise Closed("this page was closed, because nothing was heard of it for a while; load it again")
            self.heard_of[name] = time.monotonic()
            return session

    def close(self, name: str, wait: float = -1) -> None:
        """A page is gone; what it is waiting for comes to its end first, or is left after so many seconds."""
        with self.lock:
            session = self.open.pop(name, None)
            self.heard_of.pop(name, None)
        if session is None:
            return
        if not session.lock.acquire(timeout=wait):
            self.left.append(session)
            return
        try:
            session.close()
        finally:
            session.lock.release()

    def sweep(self) -> None:
        """Close what has been silent for too long."""
        with self.lock:
            late = time.monotonic() - self.idle_seconds
            silent = [name for name, at in self.heard_of.items() if at < late]
        for name in silent:
            self.close(name)


def create_app(world_model: WorldModel, choice: Choice, most_pages: int = 8, horizon: int | None = None) -> FastAPI:
    """The application; its open pages are `app.state.sessions`.

    Args:
        choice: the world to play in.
        most_pages: that may be open at once.
        horizon: frames of a film; by default those of the world.
    """
    sessions = Sessions(lambda link: Session(world_model, choice, link, horizon), most_pages)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        async def sweep() -> None:
            while True:
                await asyncio.sleep(30)
                await run_in_threadpool(sessions.sweep)

        def warm_up() -> None:  # the first film takes a second longer than all others: let nobody wait for it
            with heard(), suppress(Exception):  # what fails is said to the person whom it fails
                session = sessions.make(Link())
                try:
                    session.imagine(session.world.sentences(None)[:1])
                finally:
                    session.close()

        sweeping, warming = asyncio.create_task(sweep()), asyncio.create_task(run_in_threadpool(warm_up))
        yield
        sweeping.cancel()
        await warming  # a thread that computes must not outlive the interpreter
        for name in list(sessions.open):
            sessions.close(name, wait=1)

    app = FastAPI(title="textocvp play", lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    app.state.sessions = sessions
    page = with_films(files("experiments.play").joinpath("page.html").read_text(encoding="utf-8"))

    @app.middleware("http")
    async def add_policy(request: Request, answer: Any) -> Response:
        response: Response = await answer(request)
        response.headers["Content-Security-Policy"] = POLICY
        response.headers["Cache-Control"] = "no-store"
        return response

    def sentence(status: int) -> Callable[[Request, Exception], Response]:
        def handle(_: Request, error: Exception) -> Response:
            said = str(error.args[0] if error.args else type(error).__name__)
            return JSONResponse({"error": said if len(said) <= LONGEST_TEXT else said[:LONGEST_TEXT] + "…"}, status)

        return handle

    for kind in (Refused, ValueError, GroundingError):
        app.add_exception_handler(kind, sentence(400))
    app.add_exception_handler(Closed, sentence(410))

    @app.exception_handler(RequestValidationError)
    def handle_wrong_request(_: Request, error: RequestValidationError) -> Response:
        parts = [f"{'.'.join(map(str, one['loc'][1:]))}: {one['msg']}" for one in error.errors()]
        return JSONResponse({"error": "the request is not as it should be: " + "; ".join(parts)}, 422)

    @app.exception_handler(HTTPException)
    def handle_no_page(_: Request, error: HTTPException) -> Response:
        return JSONResponse({"error": error.detail}, error.status_code)

    @app.exception_handler(Exception)
    def handle_bug(_: Request, error: Exception) -> Response:
        said = f"this went wrong, and should not have: {type(error).__name__}. The terminal says more"
        return JSONResponse({"error": said}, 500)

    def ask(name: str, what: Callable[[Session], dict[str, Any] | None], view: bool = True) -> dict[str, Any]:
        """Let a session answer, and add the scene as it is then, and the warnings."""
        session = sessions.get(name)
        with session.lock, heard() as warnings:
            answer = what(session) or {}
            scene = {"scene": session.view()} if view else {}
        return {**answer, **scene, "warnings": list(dict.fromkeys(warnings))}

    @app.get("/")
    def show_page() -> HTMLResponse:
        return HTMLResponse(page)

    @app.post("/api/open")
    def open_page(query: Said = "") -> dict[str, Any]:
        problem = []
        try:
            world = dict(parse_qsl(query.removeprefix("?"))).get("world", choice.name)
            if world != choice.name:
                raise Refused(f"this link is of the world {world!r}, and here is {choice.name!r} (--world)")
            name, session = sessions.add(Link.parse(query))
        except (Refused, ValueError) as error:
            name, session = sessions.add(Link())  # says the same once more if there are too many pages
            problem = [str(error)]
        about = {"model": repr(world_model), "colors": list(COLORS), **session.about()}
        return {"page": name, "about": about, "problems": problem, "scene": session.view()}

    @app.post("/api/{name}/close")
    def close_page(name: str) -> dict[str, Any]:
        sessions.close(name)
        return {}

    @app.post("/api/{name}/alive")
    def hear_page(name: str) -> dict[str, Any]:
        sessions.get(name)
        return {}

    @app.post("/api/{name}/scene")
    def new_scene(name: str, query: Said) -> dict[str, Any]:
        return ask(name, lambda session: session.new_scene(Link.parse(query)))

    @app.post("/api/{name}/move")
    def move(name: str, thing: Annotated[int, Body()], x: Number, y: Number) -> dict[str, Any]:
        return ask(name, lambda session: session.table.move(thing, x, y))

    @app.post("/api/{name}/remove")
    def remove(name: str, thing: Annotated[int, Body(embed=True)]) -> dict[str, Any]:
        return ask(name, lambda session: session.table.remove(thing))

    @app.post("/api/{name}/add")
    def add(name: str, kind: Said, color: Said) -> dict[str, Any]:
        return ask(name, lambda session: session.table.add(kind, color))

    @app.post("/api/{name}/imagine")
    def imagine(name: str, texts: Annotated[list[Sentence], Body(embed=True)]) -> dict[str, Any]:
        return ask(name, lambda session: {"films": session.imagine(texts)}, view=False)

    @app.post("/api/{name}/do")
    def do(name: str, text: Annotated[Sentence, Body()], more: Annotated[bool, Body()] = False) -> dict[str, Any]:
        return ask(name, lambda session: session.do(text, more))

    @app.post("/api/{name}/goal")
    def arrange_goal(name: str, what: Said) -> dict[str, Any]:
        return ask(name, lambda session: session.arrange_goal(what))

    @app.post("/api/{name}/plan")
    def plan(name: str, text: Annotated[Sentence, Body(embed=True)] = "") -> dict[str, Any]:
        return ask(name, lambda session: session.plan(text), view=False)

    @app.post("/api/{name}/picture")
    async def upload(name: str, request: Request) -> dict[str, Any]:
        sessions.get(name)
        data = bytearray()
        async for part in request.stream():
            data += part
            if len(data) > LARGEST_PICTURE:
                size = int(request.headers.get("content-length", len(data))) / 2**20
                raise Refused(f"the picture has {size:.0f} MB; at most {LARGEST_PICTURE // 2**20} MB are taken")
        return await run_in_threadpool(ask, name, lambda one: {"done": one.upload(bytes(data))})

    @app.get("/api/{name}/film.{kind}")
    def download(name: str, kind: str) -> Response:
        session = sessions.get(name)
        with session.lock, tempfile.TemporaryDirectory() as folder:
            session.save(path := Path(folder, f"film.{kind}"))
            data = path.read_bytes()
        headers = {"Content-Disposition": f'attachment; filename="imagined.{kind}"'}
        return Response(data, media_type=MEDIA[path.suffix[1:]], headers=headers)

    return app
