"""Record files of LabVIEW's TDMS, read with the extra ``tdms``.

npTDMS, which reads them, has the GNU Lesser General Public License: it is loaded where such a file
is read, is no part of this package, and may be replaced by any other version of it.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from counterspin.errors import RecordError, installing
from counterspin.frozen import frozen
from counterspin.records.array_files import ArrayFile
from counterspin.records.dialect import Dialect, file_unit

#: Properties by which channels state their unit.
_UNITS = ("unit_string", "NI_UnitDescription", "Unit", "unit")


@frozen(eq=False)
class _ChannelArray:
    """A channel as an array of one dimension."""

    channel: Any

    @property
    def dtype(self) -> Any:
        return self.channel.dtype

    @property
    def shape(self) -> tuple[int]:
        return (len(self.channel),)

    @property
    def size(self) -> int:
        return len(self.channel)

    def __getitem__(self, index: Any) -> Any:
        return self.channel[index[0] if isinstance(index, tuple) else index]


class TdmsFile(ArrayFile):
    """Channels of a TDMS file."""

    def __init__(self, path: Path, stream: BinaryIO, dialect: Dialect) -> None:
        super().__init__(path, stream)
        with self._opened() as file:
            channels = {
                f"{group.name}/{channel.name}": (group.name, channel)
                for group in file.groups()
                for channel in group.channels()
            }
            self._places = {path: (group, c.name) for path, (group, c) in channels.items()}
            self._shapes = {path: (len(channel),) for path, (_, channel) in channels.items()}
            units = {path: _unit(channel.properties) for path, (_, channel) in channels.items()}
            steps = {_step(channel.properties) for _, channel in channels.values()}
            self.interval = steps.pop() if len(steps) == 1 else None
        self._name(self._shapes, dialect.group, mark="/")
        self.units = {name: units[path] for name, path in self._full.items()}

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        try:
            import nptdms
        except ModuleNotFoundError:
            raise RecordError(
                f"{self.path}: TDMS files need the package npTDMS. Export the table as CSV, or "
                f"install it: {installing('tdms')}."
            ) from None
        # Of a stream no index file beside it is read, whose checksum nobody takes.
        with os.fdopen(os.dup(self._stream.fileno()), "rb") as stream:
            stream.seek(0, io.SEEK_SET)
            with nptdms.TdmsFile.open(stream) as file:
                yield file

    def _shape(self, name: str) -> tuple[int, ...]:
        return self._shapes[self._full[name]]

    @contextmanager
    def _arrays(self, wanted: Sequence[str]) -> Iterator[Mapping[str, Any]]:
        with self._opened() as file:
            arrays = {}
            for name in wanted:
                group, channel = self._places[self._full[name]]
                arrays[name] = _ChannelArray(file[group][channel])
            yield arrays


def _step(properties: Mapping[str, Any]) -> float | None:
    """Return the time between samples of a waveform, s; None: the channel states none."""
    step = properties.get("wf_increment")
    return float(step) if isinstance(step, int | float) and step > 0.0 else None


def _unit(properties: Mapping[str, Any]) -> str:
    stated = (properties.get(key) for key in _UNITS)
    return next((unit for text in stated if text and (unit := file_unit(str(text)))), "")
