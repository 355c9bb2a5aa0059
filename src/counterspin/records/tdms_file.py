"""TDMS record files of LabVIEW."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from counterspin.errors import RecordError, install_command
from counterspin.frozen import frozen
from counterspin.records.array_files import ArrayFile
from counterspin.records.dialect import Dialect
from counterspin.records.unit_notation import parse_file_unit

#: Tolerance of a start time, in steps; largest number of samples, and fraction, by which channels
#: may differ in length to be truncated to the shortest.
_MAX_START_DEVIATION = 0.1
_MAX_CUT_ROWS = 16
_MAX_CUT_FRACTION = 0.01
#: Properties of a channel that may contain its unit.
_UNIT_PROPERTIES = ("unit_string", "NI_UnitDescription", "Unit", "unit")


@frozen(eq=False)
class _ChannelArray:
    """A channel as an array of one dimension."""

    channel: Any
    start: int  #: First sample to read.
    length: int

    @property
    def dtype(self) -> Any:
        return self.channel.dtype

    @property
    def shape(self) -> tuple[int]:
        return (self.length,)

    @property
    def size(self) -> int:
        return self.length

    def __getitem__(self, index: Any) -> Any:
        row_slice = index[0] if isinstance(index, tuple) else index
        start, stop, _ = row_slice.indices(self.length)
        return self.channel[self.start + start : self.start + stop]


class TdmsFile(ArrayFile):
    """Channels of a TDMS file."""

    def __init__(self, path: Path, stream: BinaryIO, dialect: Dialect) -> None:
        super().__init__(path, stream)
        with self._open() as file:
            channels = {
                f"{group.name}/{channel.name}": (group.name, channel)
                for group in file.groups()
                for channel in group.channels()
            }
            self._channel_keys = {
                path: (group, channel.name) for path, (group, channel) in channels.items()
            }
            self._row_ranges = self._align_channels(
                {path: channel for path, (_, channel) in channels.items()}
            )
            self._shapes = {path: (length,) for path, (_, length) in self._row_ranges.items()}
            units = {
                path: _find_channel_unit(channel.properties)
                for path, (_, channel) in channels.items()
            }
            steps = {_sampling_interval(channel.properties) for _, channel in channels.values()}
            self.interval = steps.pop() if len(steps) == 1 else None
        self._name_columns(self._shapes, dialect.group, separator="/")
        self.units = {name: units[path] for name, path in self._paths.items()}

    @contextmanager
    def _open(self) -> Iterator[Any]:
        try:
            import nptdms
        except ModuleNotFoundError:
            raise RecordError(
                f"{self.path}: TDMS files require the package npTDMS. Export the table as CSV, "
                f"or install it: {install_command('tdms')}.",
                code="missing-package",
            ) from None
        # A path would also read the index file, which the checksum of the record does not cover.
        with os.fdopen(os.dup(self._stream.fileno()), "rb") as stream:
            stream.seek(0, io.SEEK_SET)
            with nptdms.TdmsFile.open(stream) as file:
                yield file

    def _shape(self, name: str) -> tuple[int, ...]:
        return self._shapes[self._paths[name]]

    @contextmanager
    def _open_arrays(self, names: Sequence[str]) -> Iterator[Mapping[str, Any]]:
        with self._open() as file:
            arrays = {}
            for name in names:
                group, channel = self._channel_keys[self._paths[name]]
                start, length = self._row_ranges[self._paths[name]]
                arrays[name] = _ChannelArray(file[group][channel], start, length)
            yield arrays

    def _align_channels(self, channels: Mapping[str, Any]) -> dict[str, tuple[int, int]]:
        """Return path -> first sample and number of samples of a channel.

        Waveforms that start at different times, or end a few samples apart, are truncated to their
        common time range.
        """
        full_ranges = {path: (0, len(channel)) for path, channel in channels.items()}
        steps = {_sampling_interval(channel.properties) for channel in channels.values()}
        step = steps.pop() if len(steps) == 1 else None
        starts = [channel.properties.get("wf_start_time") for channel in channels.values()]
        if step is None or any(start is None for start in starts):
            return full_ranges
        latest_start = max(starts)
        start_offsets = [
            float((latest_start - start) / np.timedelta64(1, "ns")) * 1e-9 / step
            for start in starts
        ]
        skipped_rows = [round(rows) for rows in start_offsets]
        row_counts = [
            len(channel) - n_skipped
            for channel, n_skipped in zip(channels.values(), skipped_rows, strict=True)
        ]
        common_rows = min(row_counts)
        if any(
            abs(rows - n_skipped) > _MAX_START_DEVIATION
            for rows, n_skipped in zip(start_offsets, skipped_rows, strict=True)
        ):
            raise RecordError(
                f"{self.path}: the start times of the channels do not differ by a whole number of "
                "sampling intervals. Export the channels with a common start time.",
                code="irregular-time",
            )
        if (
            max(row_counts) - common_rows > max(_MAX_CUT_ROWS, _MAX_CUT_FRACTION * common_rows)
            or common_rows < 1
        ):
            return full_ranges
        descriptions = []
        if any(skipped_rows):
            descriptions.append(
                f"channels aligned by start time; up to {max(skipped_rows)} samples omitted"
            )
        if max(row_counts) > common_rows:
            descriptions.append(
                f"channels truncated to the length of the shortest, {common_rows} samples"
            )
        self.format_description = ", ".join(descriptions)
        return {
            path: (n_skipped, common_rows)
            for path, n_skipped in zip(channels, skipped_rows, strict=True)
        }


def _sampling_interval(properties: Mapping[str, Any]) -> float | None:
    """Return the sampling interval of a waveform, s; None if it is not stated."""
    step = properties.get("wf_increment")
    return float(step) if isinstance(step, int | float) and step > 0.0 else None


def _find_channel_unit(properties: Mapping[str, Any]) -> str:
    values = (properties.get(key) for key in _UNIT_PROPERTIES)
    return next((unit for text in values if text and (unit := parse_file_unit(str(text)))), "")
