"""A browser's part in the viewer: a websocket with viser's messages."""

from __future__ import annotations

from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import connect

WAIT_S = 30.0


class Client:
    """Opens the page at a URL as a browser does.

    Args:
      url: that the viewer printed.
      headers: of the request, in place of a browser's.

    Raises:
      websockets.exceptions.InvalidStatus: the server refused.
    """

    def __init__(self, url: str, **headers: str) -> None:
        origin = headers.pop("Origin", "/".join(url.split("/")[:3]))
        self._socket = connect(
            url.replace("http", "ws", 1).rstrip("/"),
            origin=origin,
            additional_headers=headers,
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
        )
        self.seen: list[dict[str, Any]] = []

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: Any) -> None:
        self._socket.close()

    def send(self, kind: str, **fields: Any) -> None:
        """Sends a message."""
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self) -> None:
        """Sends where its camera is; from then on it counts as connected."""
        self.send(
            "ViewerCameraMessage",
            wxyz=(1, 0, 0, 0),
            position=(3, 3, 3),
            fov=0.8,
            near=0.1,
            far=100.0,
            image_height=800,
            image_width=390,
            look_at=(0, 0, 0),
            up_direction=(0, 0, 1),
        )

    def wait_for(self, kind: str, **props: Any) -> dict[str, Any]:
        """The first message of a kind, with these properties, that was or is received."""
        for message in self.seen:
            if _is(message, kind, props):
                return message
        while True:
            for message in self.receive():
                self.seen.append(message)
            for message in self.seen:
                if _is(message, kind, props):
                    return message

    def click(self, label: str) -> None:
        """Presses the button with this label."""
        uuid = self.wait_for("GuiButtonMessage", label=label)["uuid"]
        self.send("GuiUpdateMessage", uuid=uuid, updates={"value": True})

    def choose(self, kind: str, label: str, value: Any) -> None:
        """Sets an input of the panel."""
        uuid = self.wait_for(kind, label=label)["uuid"]
        self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def receive(self) -> list[dict[str, Any]]:
        """The messages that come next."""
        raw = self._socket.recv(timeout=WAIT_S)
        assert isinstance(raw, bytes)
        size = int.from_bytes(raw[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size])
        return list(msgspec.msgpack.decode(inner)["messages"])


def _is(message: dict[str, Any], kind: str, props: dict[str, Any]) -> bool:
    found = message.get("props", {})
    return message["type"] == kind and all(found.get(key) == x for key, x in props.items())
