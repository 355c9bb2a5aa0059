"""TDMS files: groups, units, stamps, and what is wrong with them."""

import builtins

import numpy as np
import pytest
from nptdms import ChannelObject, TdmsWriter
from record_files import (
    ANGLE,
    SIGNAL,
    TIME,
    read_error_message,
    read_written_record,
    simulate_columns,
)

from counterspin.records.dialect import Dialect
from counterspin.records.formats import open_columns, read_scaled
from counterspin.records.isolation import uses_reader_process
from counterspin.records.record import ColumnSpec


def write(path, groups, properties=None):
    with TdmsWriter(path) as file:
        for group, columns in groups.items():
            # In two segments, as a recorder that goes on writing makes them.
            for part in (slice(0, 300), slice(300, None)):
                file.write_segment(
                    [ChannelObject(group, n, v[part], properties or {}) for n, v in columns.items()]
                )
    return path


def test_channels_are_read_as_columns_of_group(tmp_path):
    path = write(tmp_path / "a.tdms", {"Run": simulate_columns(), "Slow": {"T": np.arange(3.0)}})
    assert uses_reader_process(path)
    record = read_written_record(path, dialect=Dialect(group="Run"))
    np.testing.assert_array_equal(record.signals["Qx"], simulate_columns()[SIGNAL])
    columns = {"angle": ColumnSpec(f"Run/{ANGLE}"), "signals": {"Qx": ColumnSpec(f"Run/{SIGNAL}")}}
    record = read_written_record(path, time=ColumnSpec(f"Run/{TIME}"), **columns)
    np.testing.assert_array_equal(record.time, simulate_columns()[TIME])
    assert "the file has no column" in read_error_message(path)
    assert "no group 'Fast' contains columns" in read_error_message(
        path, dialect=Dialect(group="Fast")
    )


def test_index_file_is_ignored(tmp_path):
    path = write(tmp_path / "a.tdms", {"Run": simulate_columns()})
    (tmp_path / "a.tdms_index").write_bytes(b"not the truth")
    np.testing.assert_array_equal(read_written_record(path).time, simulate_columns()[TIME])


def test_units_and_time_stamps_are_read(tmp_path):
    stamps = np.datetime64("2026-03-01T12:00:00", "us") + np.arange(4) * np.timedelta64(20, "ms")
    path = write(tmp_path / "a.tdms", {"Run": {"t": stamps, "x": np.arange(4.0)}})
    (seconds,) = read_scaled(path, [ColumnSpec("t", kind="stamps")])
    np.testing.assert_allclose(seconds, [0, 0.02, 0.04, 0.06], atol=1e-9)
    with open_columns(write(path, {"Run": {"x": stamps}}, {"unit_string": "sec"})) as file:
        assert file.units == {"x": "s", "Run/x": "s"}


def test_damaged_file_and_missing_reader_raise(tmp_path, monkeypatch):
    path = write(tmp_path / "a.tdms", {"Run": simulate_columns()})
    content = path.read_bytes()
    (tmp_path / "cut.tdms").write_bytes(content[:100])
    assert "damaged" in read_error_message(tmp_path / "cut.tdms")
    (tmp_path / "no.tdms").write_bytes(b"no TDMS" * 9)
    assert "damaged" in read_error_message(tmp_path / "no.tdms")
    real = builtins.__import__

    def import_without_nptdms(name, *rest):
        if name == "nptdms":
            raise ModuleNotFoundError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", import_without_nptdms)
    with pytest.raises(Exception, match=r"CSV, or install it: `pip install '\.\[tdms\]'"):
        open_columns(path)


@pytest.mark.parametrize(("steps", "interval"), [((0.02, 0.02), 0.02), ((0.02, 0.04), None)])
def test_waveform_step_is_sampling_interval(tmp_path, steps, interval):
    with TdmsWriter(tmp_path / "a.tdms") as file:
        channels = zip("xy", steps, strict=True)
        file.write_segment(
            [ChannelObject("Run", n, np.arange(3.0), {"wf_increment": s}) for n, s in channels]
        )
    with open_columns(tmp_path / "a.tdms") as file:
        assert file.interval == interval
