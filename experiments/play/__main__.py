"""The command `textocvp play`."""

from __future__ import annotations

import asyncio
import gc
import ipaddress
import logging
import os
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import tyro

if TYPE_CHECKING:
    from fastapi import FastAPI
    from uvicorn import Server

GRACE = 2  # seconds in which answers that are under way may still be given when the server is stopped


class Mistake(Exception):
    """Something the user can put right; shown without a traceback."""


@dataclass
class PlayCommand:
    """Play with the world model in a browser: change a scene, imagine sentences, carry them out, make plans."""

    checkpoint: str | None = None
    """A bundled name, a folder, or a Hugging Face hub id owner/name; by default the one that knows the world."""
    world: Literal["rearrange", "tabletop", "cliport", "cater"] = "rearrange"
    """rearrange: blocks into bowls and onto blocks. tabletop: into bowls. cliport: the same on CLIPort's table, with
    plans of no more sentences than the goal has parts. cater: CATER's table, on which things move by themselves: scenes
    and captions, but nothing to arrange and no plans."""
    port: int = 7860
    """Where to listen; 0 takes a free one."""
    host: str = "127.0.0.1"
    """By default only this machine can open the page. With another address, such as 0.0.0.0, everyone who reaches this
    machine over the network can, without a password."""
    most_pages: int = 8
    """That may be open at once; each has a simulator of its own."""
    threads: int = 1
    """Threads for one imagination. Films are small: one thread is as fast as two, and leaves the other to others."""
    browser: bool = True
    """Open the page in a browser."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the page until Ctrl-C; the exit status."""
    command = tyro.cli(PlayCommand, prog="textocvp play", args=arguments)
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl-C does
    try:
        serve(command)
    except Mistake as error:
        print(f"textocvp: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)
    print("textocvp: stopped", file=sys.stderr)
    return 0


def serve(command: PlayCommand) -> None:
    """Listen, load the model, print the address, and serve; a Mistake where one of these cannot be."""
    if command.most_pages < 1:
        raise Mistake(f"--most-pages must be at least 1, not {command.most_pages}")
    listening = listen(command.host, command.port)
    gc.disable()  # loading takes seconds, and a tenth more where somebody looks for garbage meanwhile
    try:
        app = load(command)
    finally:
        gc.enable()
    host, port = listening.getsockname()[:2]
    alone = is_loopback(host)
    shown = f"[{host}]" if ":" in host else host
    url = f"http://{shown if alone else socket.gethostname()}:{port}/"
    print(f"textocvp play: {url} (Ctrl-C ends it)", flush=True)
    if alone:  # a page of another host that calls itself by a name for this one is not answered
        # Of an IPv6 address older versions of Starlette see no more than "[", which no other host is called.
        from fastapi.middleware.trustedhost import TrustedHostMiddleware

        app.add_middleware(TrustedHostMiddleware, allowed_hosts=[shown, "localhost", *(["["] if ":" in host else [])])
    else:
        said = f"--host {command.host}: everyone who reaches this machine over the network can open the page"
        print(f"textocvp: {said}, without a password", file=sys.stderr, flush=True)
    if command.browser:
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
    import uvicorn

    config = uvicorn.Config(app, log_level="warning", access_log=False, timeout_graceful_shutdown=GRACE)
    logging.getLogger("uvicorn.error").addFilter(_is_news)
    server = uvicorn.Server(config)
    ended = threading.Event()
    threading.Thread(target=_end_in_time, args=(server, ended), daemon=True).start()
    try:
        server.run(sockets=[listening])
    finally:
        ended.set()
        if app.state.sessions.left:
            _end()


def _end_in_time(server: Server, ended: threading.Event) -> None:
    """Nothing ends a long imagination in its thread, and nobody waits for it once the server is stopped."""
    while not server.should_exit:
        if ended.wait(0.2):
            return
    if not ended.wait(2 * GRACE):
        _end()


def _end() -> None:
    """End at once: a thread that computes would abort the interpreter, or keep it."""
    print("textocvp: stopped", file=sys.stderr, flush=True)
    os._exit(0)


def _is_news(record: logging.LogRecord) -> bool:
    """Not that what pages were waiting for ends when the server does."""
    ended = record.exc_info is not None and isinstance(record.exc_info[1], asyncio.CancelledError)
    return not ended and "timeout graceful shutdown exceeded" not in record.getMessage()


def load(command: PlayCommand) -> FastAPI:
    """The page with its model; a Mistake where a package or the checkpoint is missing."""
    try:
        import torch
        import uvicorn  # noqa: F401

        from experiments.play.server import create_app
        from experiments.play.worlds import WORLDS
    except ModuleNotFoundError as error:
        if error.name not in ("fastapi", "uvicorn"):
            raise
        raise Mistake(f"the page needs {error.name}: pip install 'textocvp[play]'") from None
    from textocvp.checkpoint import CheckpointError
    from textocvp.world_model import WorldModel

    torch.set_num_threads(max(1, command.threads))
    choice = WORLDS[command.world]
    name = command.checkpoint or choice.checkpoint
    try:
        world_model = WorldModel.from_pretrained(name)
    except CheckpointError as error:
        raise Mistake(str(error)) from None
    model = world_model.model
    if model.config.parser.num_slots == 1 or not model.predictor.uses_text:
        lacks = "slots of things" if model.predictor.uses_text else "sentences"
        raise Mistake(f"--checkpoint {name}: this model knows no {lacks}, and there is nothing to play with")
    others = [one.name for one in WORLDS.values() if one.checkpoint == name]
    if others and command.world not in others:
        said = f"{name} was trained on another world ({' or '.join(others)}): what it imagines here may mean nothing"
        print(f"textocvp: {said}", file=sys.stderr, flush=True)
    return create_app(world_model, choice, command.most_pages)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens; a Mistake that says why there is none."""
    if not 0 <= port <= 65535:
        raise Mistake(f"--port {port}: ports are numbers from 0 to 65535, and 0 takes a free one")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
    except (OSError, UnicodeError):
        raise Mistake(f"--host {host}: this machine knows no such address") from None
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen(128)
    except OSError as error:
        listening.close()
        raise Mistake(f"cannot listen at {host}, port {port}: {error.strerror}; try another --port") from None
    return listening


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine alone."""
    return ipaddress.ip_address(host).is_loopback


if __name__ == "__main__":
    sys.exit(main())
