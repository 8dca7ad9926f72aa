"""The ends of a channel as types: of a pipe in shared memory, or of a TCP connection.

An agent sends what it has experienced in one rollout, a trainer receives batches of it. A
*piece* is the experience of one `send`, or a part of its environments where the whole is too
large for the channel. A *transfer* is what travels: one or more pieces.
"""

from __future__ import annotations

from typing import TypeAlias

from gmijax.channels.pipe import PipeReader, PipeWriter
from gmijax.channels.tcp_channel import RemoteReader, RemoteWriter

ChannelWriter: TypeAlias = PipeWriter | RemoteWriter
"""The way from this agent to trainer `peer`."""

ChannelReader: TypeAlias = PipeReader | RemoteReader
"""The way from agent `peer` to this trainer."""
