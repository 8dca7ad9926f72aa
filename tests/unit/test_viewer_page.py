"""The viewer's server and page with a real websocket client."""

from __future__ import annotations

import logging
import queue
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

viser: Any = pytest.importorskip("viser")
pytest.importorskip("mjviser")

from plain_run import constant_policy  # noqa: E402
from viewer_client import WAIT_S, Client  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402

from gmijax.cli.compose import compose  # noqa: E402
from gmijax.errors import ConfigError, GmijaxError  # noqa: E402
from gmijax.player.plain_env import PlainEnv  # noqa: E402
from gmijax.viewer import requests, server  # noqa: E402
from gmijax.viewer.browser_page import BrowserPage  # noqa: E402
from gmijax.viewer.guard import Guard  # noqa: E402
from gmijax.viewer.loop import Loop  # noqa: E402
from gmijax.viewer.server import Server, close_server, open_server  # noqa: E402
from gmijax.viewer.simulation import Simulation  # noqa: E402


class Shown:
    """An anymal in two environments, and its page."""

    def __init__(self, served: Server) -> None:
        envs = [PlainEnv(compose("env=anymal").env, seed=number) for number in range(2)]
        self.simulation = Simulation(envs, constant_policy(envs[0], 0.0), seed=0)
        self.asked: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.server = served
        self.page = BrowserPage(served, self.asked, "anymal", self.simulation, has_run=True)
        self.loop = Loop(self.simulation, self.page, self.asked)

    def next(self, kind: type[Any]) -> Any:
        """The next request of a kind, which is done."""
        while True:
            request = self.asked.get(timeout=WAIT_S)
            self.loop.do(request)
            if isinstance(request, kind):
                return request


@pytest.fixture(scope="module")
def shown() -> Iterator[Shown]:
    served = open_server(Guard("127.0.0.1"), 0)
    yield Shown(served)
    close_server(served)


@pytest.fixture
def client(shown: Shown) -> Iterator[Client]:
    with Client(shown.server.url) as client:
        client.look()
        shown.next(requests.Wake)
        yield client


def status_of(url: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def test_the_page_needs_host_origin_and_token(shown: Shown) -> None:
    url = shown.server.url
    assert status_of(url) == 200
    assert status_of(url, Host="evil.example") == 403
    assert status_of(url, Origin="http://evil.example") == 403
    assert status_of(url.replace(shown.server.guard.token, "")) == 403
    assert status_of(f"{url}../../../../etc/passwd") in (403, 404)


@pytest.mark.parametrize(
    "change",
    [{"Origin": "http://evil.example"}, {"Host": "evil.example"}, {"Origin": "null"}],
)
def test_a_foreign_websocket_gets_403(shown: Shown, change: dict[str, str]) -> None:
    with pytest.raises(InvalidStatus) as refused:
        Client(shown.server.url, **change)
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize("token", ["", "wrong/"])
def test_a_websocket_without_the_token_gets_403(shown: Shown, token: str) -> None:
    url = shown.server.url.replace(f"{shown.server.guard.token}/", token)
    with pytest.raises(InvalidStatus) as refused:
        Client(url)
    assert refused.value.response.status_code == 403


def test_the_right_one_gets_the_scene_and_the_panel(client: Client) -> None:
    for label in ("Push", "Run", "Speed", "Checkpoint", "Environment", "forward (m/s)"):
        assert client.wait_for(
            {
                "Push": "GuiButtonMessage",
                "Run": "GuiButtonGroupMessage",
                "forward (m/s)": "GuiSliderMessage",
            }.get(label, "GuiDropdownMessage"),
            label=label,
        )
    assert client.wait_for("BatchedGlbMessage")["name"].startswith("/bodies/")
    assert not client.wait_for("ThemeConfigurationMessage")["show_share_button"]


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\xff\0\n" * 99,
        b"GET /" + b"a" * 200_000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 100_000 + b"\r\n",
        b"GET //[ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
)
def test_what_is_no_request_prints_nothing(
    sent: bytes,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # In a process where a page was asked for, viser hides it.
    monkeypatch.setattr(logging.getLogger("websockets.server"), "filters", [])
    served = open_server(Guard("127.0.0.1"), 0)
    try:
        with (
            suppress(ConnectionError),
            socket.create_connection(("127.0.0.1", served.get_port())) as connection,
        ):
            connection.sendall(sent)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(4096):
                pass
        assert status_of(served.url) == 200
    finally:
        close_server(served)
    assert capfd.readouterr() == ("", "")
    assert not caplog.records  # pytest keeps what a logger would have printed.


def test_nobody_can_open_a_public_tunnel(
    shown: Shown, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Any] = []

    def tunnel(*args: Any) -> Any:
        opened.append(args)
        raise AssertionError("a tunnel is opened")

    monkeypatch.setattr(viser._viser, "ViserTunnel", tunnel)
    client.send("ShareUrlRequest")
    client.send("ShareUrlDisconnect")
    client.click("Push")  # What comes after it is handled after it.
    shown.next(requests.Push)
    executor = shown.server._thread_executor
    executor.submit(lambda: None).result(WAIT_S)
    assert not opened
    assert shown.server.request_share_url() is None
    assert shown.server._share_tunnel is None


def test_the_push_button_moves_the_robot(shown: Shown, client: Client) -> None:
    shown.simulation.reset()
    shown.simulation.step()
    before = shown.simulation.envs[0].data.qvel[:2].copy()
    client.click("Push")
    assert shown.next(requests.Push).speed_m_per_s == pytest.approx(1.0)
    shown.simulation.step()
    change = shown.simulation.envs[0].data.qvel[:2] - before
    assert np.linalg.norm(change) > 0.5


def test_what_is_set_in_the_panel_reaches_the_loop(shown: Shown, client: Client) -> None:
    client.choose("GuiButtonGroupMessage", "Run", "Pause")
    shown.next(requests.Pause)
    assert shown.loop.view.paused
    client.choose("GuiButtonGroupMessage", "Run", "Play")
    shown.next(requests.Pause)
    assert not shown.loop.view.paused
    client.choose("GuiDropdownMessage", "Speed", "2 x")
    assert shown.next(requests.SetSpeed).speed == 2.0
    client.choose("GuiSliderMessage", "forward (m/s)", 0.5)
    assert shown.next(requests.SetCommand).command == pytest.approx((0.5, 0.0, 0.0))
    client.choose("GuiDropdownMessage", "Environment", "2")
    shown.next(requests.Select)
    assert shown.loop.view.selected == 1


def test_the_mouse_names_environment_and_body(shown: Shown, client: Client) -> None:
    base = shown.simulation.model.body("base").id
    drag = {
        "name": f"/bodies/{base}/0",
        "instance_index": 1,
        "start_screen_pos": (0.5, 0.5),
        "end_screen_pos": (0.6, 0.4),
        "button": "left",
        "modifier": "cmd/ctrl",
    }
    client.wait_for("BatchedGlbMessage")
    for phase in ("start", "update", "end"):
        client.send(
            "SceneNodeDragMessage",
            phase=phase,
            start_position=(1.0, 0.0, 0.5),
            end_position=(1.0, 0.0, 1.5),
            **drag,
        )
    start, update, end = (shown.next(requests.Drag) for _ in range(3))
    assert (start.env, start.body) == (1, base)
    np.testing.assert_allclose(update.pointer - update.grabbed, (0.0, 0.0, 1.0), atol=1e-6)
    assert end.pointer is None


def test_numbers_and_pictures_are_sent(shown: Shown, client: Client) -> None:
    assert shown.page.num_clients() >= 1
    shown.simulation.step()
    shown.page.draw(shown.simulation, shown.loop.view)
    shown.page.write(shown.simulation, shown.loop.view)

    def texts(message: dict[str, Any]) -> str:
        return str(message.get("updates", {}).get("content", ""))

    while "yaw_rate" not in "".join(map(texts, client.seen)):
        client.seen += client.receive()


def test_names_are_no_markup() -> None:
    from gmijax.viewer.panel import bars_html
    from gmijax.viewer.simulation import Episode

    terms = {"<script>": 1.0, "cost": -0.5}
    text = bars_html(Episode(1, terms, terms, 2, None))
    assert "<script>" not in text
    assert "left:25.0%;width:25.0%" in text  # A cost, to the left.


def test_a_taken_port_is_not_waited_for(shown: Shown) -> None:
    taken = shown.server.get_port()
    other = open_server(Guard("127.0.0.1"), taken)
    try:
        assert other.get_port() != taken
        assert status_of(other.url) == 200
    finally:
        close_server(other)


@pytest.mark.parametrize(
    "host", ["256.1.1.1", "no.such.host.invalid", "\0", "é" * 300, "", "8.8.8.8"]
)
def test_an_address_where_nothing_can_listen_is_named(host: str) -> None:
    with pytest.raises(ConfigError, match=r"view\.host="):
        open_server(Guard(host), 0)


def test_a_viser_that_cannot_be_guarded_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Unguarded(server.Server):
        def __init__(self, **_: Any) -> None: ...

        def stop(self) -> None: ...

    monkeypatch.setattr(server, "Server", Unguarded)
    with pytest.raises(GmijaxError, match="cannot be guarded"):
        open_server(Guard("127.0.0.1"), 0)


def test_a_closed_server_leaves_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    threads = set(threading.enumerate())
    served = open_server(Guard("127.0.0.1"), 0)
    port = served.get_port()
    close_server(served)
    with socket.socket() as free:
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free.bind(("127.0.0.1", port))
    assert not [one for one in set(threading.enumerate()) - threads if not one.daemon]
    assert capfd.readouterr().out == ""


def test_the_viewer_needs_no_jax() -> None:
    code = (
        "import sys; import gmijax.view, gmijax.viewer.browser_page, gmijax.player.plain_env as p;"
        "from gmijax.cli.compose import compose;"
        "env = p.PlainEnv(compose('env=ant').env); env.step([0.0] * 8);"
        "sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
