"""Connections that take nothing from others: who shows no key has little time and little room.

Every user of this machine can connect. So of connections without the key there are few, the oldest
giving way to a new one; a request without the key is there within seconds or not at all, and is
read in small parts. The page, which has the key, is answered whatever others do.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any, Final

import h11
import uvicorn
from starlette.datastructures import Headers
from uvicorn.protocols.http.h11_impl import H11Protocol

from counterspin.application.guard import Door

#: Most connections without the key; a machine gives a process 256 descriptors or more.
MOST_STRANGERS: Final = 128

#: How long a request without the key may take to arrive, s.
STRANGER_SECONDS: Final = 5.0

#: Most bytes that are read at once, without the key and with it.
_STRANGER_BYTES: Final = 4096
_KNOWN_BYTES: Final = 1 << 18

#: Connections that are taken in one turn, and those that the system keeps waiting meanwhile. A
#: stranger gives way only after some turns, in which whoever has the key has shown it.
AT_ONCE: Final = 16
_WAITING: Final = 1024


class Connection(H11Protocol, asyncio.BufferedProtocol):
    """A connection, closed where what comes is no HTTP after an answer, or does not come.

    words: As of uvicorn's protocols.
    """

    def __init__(self, door: Door, **words: Any) -> None:
        super().__init__(**words)
        self._door = door
        self._known = False
        self._space = bytearray(_STRANGER_BYTES)
        self._end: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin; the oldest strangers end where there are too many."""
        super().connection_made(transport)
        self._born = self.loop.time()
        self._wait()
        strangers = [
            one
            for one in self.connections
            if isinstance(one, Connection) and not (one._known or one.transport.is_closing())
        ]
        if len(strangers) > MOST_STRANGERS:
            min(strangers, key=lambda one: one._born).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._wait_no_longer()
        super().connection_lost(exc)

    def get_buffer(self, _: int) -> bytearray:
        """Return what takes the next bytes."""
        return self._space

    def buffer_updated(self, nbytes: int) -> None:
        """Read what has come."""
        self.data_received(bytes(self._space[:nbytes]))

    def data_received(self, data: bytes) -> None:
        """Read what has come; nothing more of who has not shown the key, until it is asked for."""
        try:
            super().data_received(data)
        except h11.LocalProtocolError:
            self.transport.close()
        if self.headers is not None:
            self._known = self._door.admits(Headers(raw=self.headers))
        if self._known:
            if len(self._space) < _KNOWN_BYTES:
                self._space = bytearray(_KNOWN_BYTES)
            self._wait_no_longer()
            return
        arriving = self.conn.their_state is h11.SEND_BODY
        if arriving and self.cycle.body and not self.cycle.response_complete:
            self.flow.pause_reading()
        if arriving or self.conn.their_state is h11.IDLE:
            self._wait()
        else:
            self._wait_no_longer()

    def _wait(self) -> None:
        if self._end is None:
            self._end = self.loop.call_later(STRANGER_SECONDS, self.transport.abort)

    def _wait_no_longer(self) -> None:
        if self._end is not None:
            self._end.cancel()
            self._end = None


class Server(uvicorn.Server):
    """A server that takes a few connections in each turn, and has the system keep the others."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen."""
        asyncio.get_running_loop().set_exception_handler(_complain)
        await super().startup(sockets)
        for listener in sockets or ():
            # How many asyncio takes in a turn is how many the system was to keep.
            listener.listen(_WAITING)


def _complain(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Tell what nobody has foreseen; that the system refuses a connection is no news."""
    if not isinstance(context.get("exception"), OSError):
        loop.default_exception_handler(context)
