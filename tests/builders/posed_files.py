"""Files of other programs with a record of a sensor in twelve poses."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from nptdms import ChannelObject, TdmsWriter
from posed_records import simulate_poses

POSED = simulate_poses(3.0, 1.0)
AXES = ("ax", "ay", "az")
COLUMNS = dict(zip(AXES, POSED.values.T, strict=True))


def write_compound_file(path: Path) -> None:
    """Write a structured array with h5py."""
    rows = np.empty(len(POSED.time), dtype=[(name, float) for name in ("time", *AXES)])
    for name, values in zip(rows.dtype.names, [POSED.time, *POSED.values.T], strict=True):
        rows[name] = values
    with h5py.File(path, "w") as file:
        file["log"] = rows


def write_waveform_file(
    path: Path, ends: tuple[int, ...] = (0, 0, 0), skipped: tuple[int, ...] = (0, 0, 0)
) -> None:
    """Write channels of a TDMS file that end or begin some samples earlier or later."""
    with TdmsWriter(path) as file:
        start_time = np.datetime64("2026-03-01T12:00:00", "us")
        file.write_segment(
            [
                ChannelObject(
                    "Run",
                    name,
                    values[skip : len(values) - end],
                    {
                        "wf_increment": 0.01,
                        "wf_start_time": start_time + np.timedelta64(10 * skip, "ms"),
                        "unit_string": "m/s^2",
                    },
                )
                for (name, values), end, skip in zip(COLUMNS.items(), ends, skipped, strict=True)
            ]
        )
