"""The live view: worlds of a running environment in a browser, with pause and choice."""

import contextlib
import inspect
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.parse import urlsplit
from urllib.request import urlopen

import msgspec
import numpy as np
import pytest
import viser
import viser.infra._infra
from browser import EXECUTABLE, browse
from compositions import load_config, refusal
from environments import SHORT_REACH, GetStage, Patch, configure, has_gl
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

import mjstack.jobs.showing as showing
import mjstack.report.web as web
from mjstack.cli import run
from mjstack.drivers.driver import Driver
from mjstack.envs import Env, build_env
from mjstack.episodes.stage import Progress
from mjstack.errors import MjstackError
from mjstack.jobs import check_job
from mjstack.jobs.live import LiveView, read_worlds
from mjstack.report.geometry import Shapes
from mjstack.report.web import start_server, stop_server

GL = pytest.mark.skipif(not has_gl(), reason="MuJoCo does not draw offscreen here")


PPO = (
    *("job=train", "trainer=ppo", "task=reach", "sim=native", "nworld=4", "job.iterations=4"),
    *("job.save_every=2", "job.hidden=[16]", "job.horizon=4", "job.epochs=2", "job.minibatches=2"),
    *("gate.success.rate=0.0", "web.episode=false", *SHORT_REACH),
    "termination.time_out.params.steps=30",
)


def refusal_of(*overrides: str) -> str:
    return refusal(lambda: check_job(load_config(overrides), overrides))


@pytest.mark.parametrize(
    ("text", "count", "worlds"),
    [
        ("0-3", 10, [0, 1, 2, 3]),
        ("7, 2-3,7", 10, [7, 2, 3]),
        ("8-12", 10, [8, 9]),
        ("0-999999999", 4096, list(range(64))),
        ("10", 10, []),
        ("3-", 10, []),
        ("9" * 5000, 10, []),
    ],
)
def test_worlds_are_read_from_text(text: str, count: int, worlds: list[int]) -> None:
    assert read_worlds(text, count) == worlds


class NoActions(Driver):
    """Stands for the driver of worlds that a test moves itself: it has no phases."""

    def __init__(self, env: Env) -> None:
        super().__init__(env.nworld, sys.maxsize, env.device)

    def command(self) -> Any:
        raise NotImplementedError


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait for something that comes within 20 s."""
    until = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.fixture
def server(monkeypatch: Patch) -> Iterator[Any]:
    """A server at which somebody looks."""
    opened = start_server("127.0.0.1", 0)
    monkeypatch.setattr(opened, "get_clients", lambda: {0: None})
    yield opened
    stop_server(opened)


def test_worlds_pause_and_are_chosen(server: Any, get_stage: GetStage, monkeypatch: Patch) -> None:
    stage = get_stage("so101")
    env = build_env(configure("task=reach", "reset=randomized"), nworld=5)
    view = LiveView(server, stage)
    view.begin("training")
    env.reset()
    view.start(env, NoActions(env))
    made: list[int] = []
    on = threading.Event()

    def play() -> None:
        for step in range(200):
            if on.is_set():
                break
            env.sim.qpos[:, 0] = 0.001 * step
            env.advance()
            view.after_step(step)
            made.append(step)

    def settle(count: int) -> None:
        wait_until(lambda: len(made) == count)
        time.sleep(0.1)
        assert len(made) == count

    view._toggle()
    worker = threading.Thread(target=play)
    worker.start()
    try:
        settle(0)  # it waits in its first step
        assert "training, step 1, 5 worlds" in view._status.value
        assert view._view is not None
        # Another choice of worlds, while it waits
        view._worlds.value = "4, 1"
        wait_until(lambda: view._numbers == [4, 1])
        time.sleep(0.2)
        places, _ = Shapes(stage.assets.visual_model).poses(
            env.sim.qpos[[4, 1]].double().cpu().numpy()
        )
        for shape, handle in view._view._handles:
            held = np.asarray(handle.batched_positions)
            assert np.allclose(held[:, 2], places[:, shape.pose, 2], atol=1e-4)
        view._worlds.value = "99"
        line = "Worlds: '99' names none, expected numbers from 0 to 4"
        wait_until(lambda: line in view._status.value)
        assert view._numbers == [4, 1]
        values = zip(env.reward_manager.names, env.reward_manager.values[4].tolist(), strict=True)
        for name, value in values:
            assert f"{name} {value:.3g}" in view._status.value
        assert "world 4: step" in view._status.value
        view._toggle()
        wait_until(lambda: len(made) > 3)
        view._toggle()
    finally:
        on.set()
        if view.paused:
            view._toggle()
        worker.join(timeout=30.0)
        env.close()
    assert not worker.is_alive()
    assert view.aside > 0.3


def test_without_a_browser_nothing_is_drawn(
    server: Any, get_stage: GetStage, monkeypatch: Patch
) -> None:
    env = build_env(configure("task=reach"), nworld=2)
    env.reset()
    monkeypatch.setattr(server, "get_clients", dict)
    view = LiveView(server, get_stage("so101"))
    view.start(env, NoActions(env))
    drawn: list[int] = []
    monkeypatch.setattr(view, "_show", drawn.append)
    for step in range(3):
        time.sleep(0.05)
        view.after_step(step)
    assert drawn == []
    assert view.aside == 0.0
    # Real time is kept all the same, and is none of the episode's.
    view._pace.value = "real time"
    began = time.perf_counter()
    for step in range(20):
        view.after_step(step)
    waited = time.perf_counter() - began
    env.close()
    assert drawn == []
    assert waited > 0.1  # of 0.4 s, as it makes up for 0.2 s
    assert view.aside > 0.9 * waited


@pytest.mark.full
def test_a_paused_run_goes_on_when_the_last_browser_leaves(
    server: Any, get_stage: GetStage, monkeypatch: Patch
) -> None:
    """Not at once: a page that is loaded anew leaves and comes back."""
    env = build_env(configure("task=reach"), nworld=2)
    env.reset()
    lines: list[str] = []
    stage = get_stage("so101").with_config(configure("task=reach"))
    stage.progress = Progress(print_line=lines.append)
    view = LiveView(server, stage)
    view.start(env, NoActions(env))
    view._toggle()
    began = time.perf_counter()
    monkeypatch.setattr(
        server, "get_clients", lambda: {} if time.perf_counter() - began > 0.5 else {0: None}
    )
    worker = threading.Thread(target=view.after_step, args=(0,), daemon=True)
    worker.start()
    worker.join(timeout=2.0)
    assert worker.is_alive()
    worker.join(timeout=10.0)
    env.close()
    assert not worker.is_alive()
    assert not view.paused
    assert lines == ["live view: the run was paused, and goes on without a browser"]


@pytest.fixture
def port() -> int:
    """A port that no program has."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_port_in_use_is_one_line() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        line = refusal_of("view=web", f"web.port={taken}")
    assert f"web.port={taken}: expected a port that is free on 127.0.0.1" in line
    assert "Set another web.port" in line


EVIL = "<img src=x onerror=alert(1)>"
TOKEN = "t0ken"
COOKIE = {"Cookie": f"a=b; mjstack-{TOKEN}=1"}


@pytest.fixture(scope="module")
def guarded() -> Iterator[Callable[[str], int]]:
    """The port of a server that listens at an address."""
    servers = {host: start_server(host, 0, TOKEN) for host in ("127.0.0.1", "0.0.0.0")}
    yield lambda host: servers[host].get_port()
    for opened in servers.values():
        stop_server(opened)


def get(port: int, path: str, headers: dict[str, str]) -> tuple[int, str, dict[str, str]]:
    """Status, beginning of the content and headers of an answer."""
    connection = HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    text = answer.read(2000).decode(errors="replace")
    connection.close()
    return answer.status, text, dict(answer.headers)


def opens_websocket(port: int, path: str, headers: dict[str, str]) -> bool:
    """Whether a websocket opens and brings the scene's messages; a raw one, with these headers."""
    lines = {
        "Host": f"127.0.0.1:{port}",
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
    } | headers
    request = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    with socket.create_connection(("127.0.0.1", port), timeout=20) as raw:
        raw.sendall(f"GET {path} HTTP/1.1\r\n{request}\r\n".encode())
        answer = raw.recv(4096)
    assert answer.startswith((b"HTTP/1.1 101 ", b"HTTP/1.1 403 ")), answer
    return answer.startswith(b"HTTP/1.1 101 ")


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_page_needs_the_token(guarded: Callable[[str], int], host: str) -> None:
    """Its answer makes the token a cookie that no script reads and no other site sends."""
    port = guarded(host)
    for path in ("/", "/?token=", "/?token=wrong", "/assets/x.hdr", f"/{TOKEN}"):
        status, text, headers = get(port, path, {"Cookie": "mjstack-=1; mjstack-wrong=1"})
        assert (status, "Set-Cookie" in headers) == (403, False)
        assert "Open the whole address that the run has printed" in text
    status, text, headers = get(port, f"/?token={TOKEN}", {})
    assert status == 200
    assert "<html" in text
    cookie = f"mjstack-{TOKEN}=1; HttpOnly; SameSite=Strict; Path=/"
    assert headers["Set-Cookie"] == cookie
    assert get(port, "/", COOKIE)[0] == 200
    assert opens_websocket(port, "/", COOKIE)
    assert not opens_websocket(port, "/", {})


# Host, Origin, and whether a server on this machine alone answers
NAMES = [
    ("127.0.0.1:{port}", "http://127.0.0.1:{port}", True),
    ("localhost:9000", "http://localhost:9000", True),  # ssh -L
    ("[::1]:9000", "http://[::1]:9000", True),
    ("localhost", "http://localhost", True),
    ("127.0.0.1:{port}", "http://evil.example", False),
    ("127.0.0.1:{port}", "http://127.0.0.1:8999", False),  # another server of this machine
    ("127.0.0.1:{port}", "null", False),
    ("evil.example:{port}", "http://evil.example:{port}", False),  # DNS rebinding
    ("localhost.evil.example", "http://localhost.evil.example", False),
    ("127.0.0.1@evil.example", "http://127.0.0.1@evil.example", False),
]


@pytest.mark.parametrize(("host", "origin", "allowed"), NAMES)
def test_other_origins_and_hosts_are_refused(
    guarded: Callable[[str], int], host: str, origin: str, allowed: bool
) -> None:
    """Also with the token. Where other machines are let in, a page has to be from the same one."""
    for address in ("127.0.0.1", "0.0.0.0"):
        port = guarded(address)
        names = {"Host": host.format(port=port), "Origin": origin.format(port=port)}
        same = names["Origin"] == f"http://{names['Host']}"
        lets_in = same and (allowed or address == "0.0.0.0")
        assert opens_websocket(port, "/", COOKIE | names) == lets_in
        assert opens_websocket(port, f"/?token={TOKEN}", names) == lets_in
        assert (get(port, f"/?token={TOKEN}", names)[0] == 200) == lets_in
        assert not opens_websocket(port, "/", names)


def test_a_message_of_a_browser_is_short(guarded: Callable[[str], int]) -> None:
    """A text of megabytes would slow the run."""
    port = guarded("127.0.0.1")
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    for size, code in ((1000, None), (100_000, 1009)):
        address = f"ws://127.0.0.1:{port}"
        with connect(address, subprotocols=[protocol], additional_headers=COOKIE) as websocket:
            updates = {"value": size * "x"}
            message = {"type": "GuiUpdateMessage", "uuid": "none", "updates": updates}
            websocket.send(msgspec.msgpack.encode(message))
            with contextlib.suppress(TimeoutError, ConnectionClosed):
                while True:
                    websocket.recv(timeout=1.0)
            assert websocket.close_code == code


def test_viser_has_what_the_guard_uses() -> None:
    """It has no hook: its server hands ``process_request`` and ``max_size`` to `websockets`."""
    source = inspect.getsource(viser.infra._infra.WebsockServer._background_worker)
    for text in ("websockets.asyncio.server.serve(", "process_request=(", "max_size="):
        assert source.count(text) == 1


def test_a_viser_that_cannot_be_guarded_is_refused(monkeypatch: Patch) -> None:
    class Server:
        def __init__(self, **_: object) -> None: ...
        def stop(self) -> None: ...

    monkeypatch.setattr(viser, "ViserServer", Server)
    with pytest.raises(MjstackError, match=r"viser .* cannot be guarded, expected 1\.1\.1"):
        start_server("127.0.0.1", 0)


def test_texts_are_plain_and_short(server: Any, get_stage: GetStage, monkeypatch: Patch) -> None:
    """No markdown or HTML shows what a browser has sent or a configuration names."""
    env = build_env(configure("task=reach"), nworld=2)
    env.reset()
    for kind in ("add_markdown", "add_html"):
        monkeypatch.delattr(viser.GuiApi, kind)
    view = LiveView(server, get_stage("so101"))
    view.begin(EVIL)
    view.start(env, NoActions(env))
    view._worlds.value = EVIL + 20_000_000 * "x"
    view._show(0)
    env.close()
    assert isinstance(view._status, viser.GuiTextHandle)
    assert EVIL in view._status.value
    assert len(view._status.value) < 1000


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["view=web", "web.host=203.0.113.1"], "web.host=203.0.113.1: expected an address of this"),
        (["view=web", "web.host=::1"], "web.host=::1: expected an address of this machine"),
        (["view=web", "gates=[capacity]"], "expected a gate that shows worlds: baseline"),
        (["view=web", "job=collect"], "expected false with job=collect"),
        (["view=true"], "view=true: expected one of false, web"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_one_line(args: list[str], says: str) -> None:
    assert says in refusal_of(*args)


def test_without_viser_it_says_what_to_install(monkeypatch: Patch) -> None:
    monkeypatch.setattr(web, "find_spec", lambda name: None)
    line = refusal_of("view=web")
    assert "view=web needs viser, which is not installed: run pip install 'mjstack[web]'" in line


@pytest.mark.full
def test_worlds_move_as_without_it(tmp_path: Path, port: int) -> None:
    """The same batch with the view and without ends bit for bit alike."""
    ends = []
    for view in ("false", "web"):
        out = tmp_path / view
        args = ["gates=[batch]", "nworld=3", "sim=native", f"view={view}", f"web.port={port}"]
        assert run([*args, f"hydra.run.dir={out}"]) == 0
        with np.load(out / "batch_seed0.npz") as held:
            ends.append(held["qpos"])
    assert np.array_equal(*ends)


JOBS: dict[str, tuple[tuple[str, ...], set[str]]] = {
    "play": (("job=play", "task=reach", "sim=native", "nworld=1"), {"play"}),
    "ppo": (PPO, {"train", "success"}),
}


@pytest.mark.full
@pytest.mark.parametrize("job", JOBS)
def test_jobs_serve_the_live_view(job: str, tmp_path: Path, port: int, monkeypatch: Patch) -> None:
    """A page on this machine shows the worlds of each part; after the end there is none."""
    command, parts = JOBS[job]
    looked: dict[str, str] = {}
    tokens: list[str] = []

    def start(host: str, number: int, token: str) -> Any:
        opened = start_server(host, number, token)
        tokens[:] = [token]
        monkeypatch.setattr(opened, "get_clients", lambda: {0: None})
        return opened

    def look(self: LiveView, step: int) -> None:
        after_step(self, step)
        if self._section not in looked:
            with urlopen(f"http://127.0.0.1:{port}/?token={tokens[0]}", timeout=60) as page:
                assert b"<html" in page.read()
            looked[self._section] = self._status.value

    after_step = LiveView.after_step
    monkeypatch.setattr(LiveView, "after_step", look)
    monkeypatch.setattr(showing.web, "start_server", start)
    where = ["view=web", f"web.port={port}"]
    folder = f"hydra.run.dir={tmp_path}" if job == "play" else f"job.folder={tmp_path}"
    assert run([*command, *where, folder]) == 0
    assert looked.keys() == parts
    worlds = "1 world" if job == "play" else "4 worlds"
    assert all(f"{part}" in text and worlds in text for part, text in looked.items()), looked
    with pytest.raises(URLError):
        urlopen(f"http://127.0.0.1:{port}", timeout=5)


@pytest.mark.full
@pytest.mark.skipif(EXECUTABLE is None, reason="no Chromium is installed here")
def test_a_browser_looks_at_a_run(tmp_path: Path, port: int) -> None:
    """It pauses a run; Ctrl-C ends the run while it waits."""
    args = ["gates=[batch]", "nworld=4", "gate.batch.seeds=1000", "sim=native"]
    args += ["view=web", f"web.port={port}"]
    command = [sys.executable, "-m", "mjstack", *args, f"hydra.run.dir={tmp_path}/out"]
    log = tmp_path / "log"
    with log.open("w") as told:
        process = subprocess.Popen(command, stdout=told, stderr=subprocess.STDOUT)
    button = "[...document.querySelectorAll('button')].find(b => b.innerText == '{}')"
    text = "[document.body, ...document.querySelectorAll('textarea')]"
    text += ".map(part => part.innerText + (part.value ?? '')).join(' ')"
    try:
        until = time.monotonic() + 120.0
        while "live view: http://127.0.0.1" not in log.read_text():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until
            time.sleep(0.1)
        address = log.read_text().partition("live view: ")[2].split()[0]
        with browse(1200, 800) as tab:
            tab.open(f"http://127.0.0.1:{port}")
            assert "with its token" in tab.run("document.body.innerText")
        with browse(1200, 800) as tab:  # what the other page was refused is logged late
            tab.open(address)
            tab.wait(f"!!{button.format('Pause')}")
            tab.run(f"{button.format('Pause')}.click()")
            tab.wait(f"{text}.includes('4 worlds') && {text}.includes('Go on')")
            time.sleep(1.0)
            before = tab.run(text)
            time.sleep(1.0)
            assert tab.run(text) == before
            assert tab.problems == []
            assert {urlsplit(request).netloc for request in tab.requests} == {f"127.0.0.1:{port}"}
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()
