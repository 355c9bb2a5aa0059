"""The record of a run in the formats of various recorders, loggers and spreadsheets.

`FILES`: what a file is like -> what writes it, and its ending. A frame has time_s, angle_rad,
east_m and north_m.
"""

from datetime import datetime, timedelta

import numpy as np
from workbooks import write_workbook

_BEGUN = datetime(2026, 1, 12, 10, 59, 58)

FILES = {}


def _file(name, ending=".csv"):
    def register(write):
        FILES[name] = (write, ending)
        return write

    return register


def _put(path, head, rows, mark, *, encoding="utf-8", end="\n"):
    path.write_bytes(end.join([*head, *map(mark.join, rows), ""]).encode(encoding))


def _degrees(frame):
    return np.degrees(frame["angle_rad"].to_numpy())


def _cells(frame, *, time=None, angle=None, mark=".", scale=1.0):
    """Return rows of text: time, angle in degrees, east and north; `mark` is the decimal mark."""
    columns = [
        frame["time_s"] if time is None else time,
        _degrees(frame) if angle is None else angle,
        *(scale * frame[name].to_numpy() for name in ("east_m", "north_m")),
    ]
    return [
        [x if isinstance(x, str) else f"{x:.12g}".replace(".", mark) for x in row]
        for row in zip(*columns, strict=True)
    ]


def _stamps(frame, time_format):
    moments = [_BEGUN + timedelta(seconds=t) for t in frame["time_s"]]
    return [
        moment.strftime(time_format).replace("%L", f"{moment.microsecond // 1000:03d}")
        for moment in moments
    ]


def _plain(time="Time [s]", angle="Angle [deg]", mark=","):
    return [mark.join([time, angle, "East [m]", "North [m]"])]


@_file("LabVIEW, an x for each channel", ".lvm")
def _(frame, path):
    head = ["LabVIEW Measurement\t", "X_Columns\tMulti", "***End_of_Header***\t", "\t"]
    head += ["Channels\t3\t\t\t\t\t", "Y_Unit_Label\tdeg\t\tm\t\tm\t"]
    head += ["X_Dimension\tTime\t\tTime\t\tTime\t", "Delta_X\t0.05\t\t0.05\t\t0.05\t"]
    head += ["***End_of_Header***\t\t\t\t\t\t"]
    head += ["X_Value\tAngle\tX_Value\tEast\tX_Value\tNorth\tComment"]
    rows = [[t, a, t, e, t, n, ""] for t, a, e, n in _cells(frame)]
    _put(path, head, rows, "\t", end="\r\n")


@_file("LabVIEW, no x", ".lvm")
def _(frame, path):
    head = ["LabVIEW Measurement\t", "X_Columns\tNo", "***End_of_Header***\t", ""]
    head += ["Y_Unit_Label\tdeg\tm\tm\t", "X_Dimension\tTime\tTime\tTime\t"]
    head += ["Delta_X\t0.05\t0.05\t0.05\t", "***End_of_Header***\t\t\t\t"]
    head += ["\tAngle\tEast\tNorth\tComment"]
    _put(path, head, [["", *row[1:], ""] for row in _cells(frame)], "\t", end="\r\n")


@_file("Dewesoft")
def _(frame, path):
    head = ["Data info", r"File name;C:\Data\Test 12.dxd", "Start time;12.01.2026 10:59:58"]
    head += ["Number of channels;3", "Sample rate;20", "", "Data1"]
    head += ["Time (s);Angle (deg);East (m);North (m)"]
    _put(path, head, _cells(frame, mark=","), ";", encoding="cp1252", end="\r\n")


@_file("Dewesoft, text with events", ".txt")
def _(frame, path):
    head = ["Data File Name:\tTest_0012.dxd", "Sample Rate:\t20 Hz", "", "Events"]
    head += ["Event Type\tEvent\tTime", "1\tstoring started at\t0.000", ""]
    head += ["Time\tAngle\tEast\tNorth", "[s]\t[°]\t[m]\t[m]"]
    _put(path, head, _cells(frame), "\t", encoding="cp1252", end="\r\n")


@_file("catman, sensors below the units", ".asc")
def _(frame, path):
    head = ["HBM CatmanEasy V5.4", "Messrate: 20 Hz", ""]
    head += ["Zeit  1 - Standardmessrate\tWinkel\tWeg Ost\tWeg Nord", "[s]\t[°]\t[mm]\t[mm]"]
    head += ["MX840B CH 1\tMX840B CH 2\tMX840B CH 3\tMX840B CH 4", "20 Hz\t20 Hz\t20 Hz\t20 Hz"]
    rows = _cells(frame, mark=",", scale=1000.0)
    _put(path, head, rows, "\t", encoding="cp1252", end="\r\n")


@_file("BenchVue, milliseconds behind a colon")
def _(frame, path):
    head = ["Name:,Data 12", "Acquisition Date:,1/12/2026 10:59:58 AM", ""]
    head += ["Scan,Time,101 <Angle> (deg),102 <East> (m),103 <North> (m)"]
    rows = _cells(frame, time=_stamps(frame, "%m/%d/%Y %H:%M:%S:%L"))
    _put(path, head, [[str(i), *row] for i, row in enumerate(rows, 1)], ",")


@_file("Keithley, decimal commas and a delimiter too many")
def _(frame, path):
    head = ["Gerät;Keithley DAQ6510", "Datum;12.01.2026", ""]
    head += ["Relativzeit (s);CH101 Winkel (°);CH102 Ost (m);CH103 Nord (m);"]
    rows = [[*row, ""] for row in _cells(frame, mark=",")]
    _put(path, head, rows, ";", encoding="cp1252", end="\r\n")


@_file("Siemens trace")
def _(frame, path):
    head = ['Trace;"Trace_1"', 'Abtastung;"50 ms"']
    head += ['"Index";"Zeit [µs]";"Winkel [°]";"Ost [m]";"Nord [m]"']
    time = [str(round(1e6 * t)) for t in frame["time_s"]]
    rows = [[str(i), *row] for i, row in enumerate(_cells(frame, time=time, mark=","))]
    _put(path, head, rows, ";", encoding="cp1252", end="\r\n")


@_file("Yokogawa, names and units behind keys")
def _(frame, path):
    head = ['"Header Size","16"', '"Model Name","DL850E"', '"TraceName","Angle","East","North",']
    head += ['"BlockSize","400","400","400",', '"VUnit","deg","m","m",']
    head += ['"HResolution","5.0E-02","5.0E-02","5.0E-02",', '"HUnit","s","s","s",']
    head += ['"Date","2026/01/12","2026/01/12","2026/01/12",']
    head += ['"Time","10:59:58.000","10:59:58.000","10:59:58.000",']
    _put(path, head, [["", *row[1:], ""] for row in _cells(frame)], ",", end="\r\n")


@_file("Yokogawa, tags and a clock of whole seconds")
def _(frame, path):
    head = ["Device Type,GP10", "Scan,50 ms", "Ch.,,,AI0001,AI0002,AI0003"]
    head += ["Tag,,,Angle,East,North", "Unit,,,deg,m,m", "Date,Time,msec,,,"]
    stamps = (_stamps(frame, form) for form in ("%Y/%m/%d", "%H:%M:%S", "%L"))
    rows = [[*s, *row[1:]] for *s, row in zip(*stamps, _cells(frame), strict=True)]
    _put(path, head, rows, ",")


@_file("Graphtec, signed numbers")
def _(frame, path):
    head = ["Vendor,GRAPHTEC Corporation", "Sampling interval,50ms", "Total data points,400"]
    head += ["Start time,2026/01/12,10:59:58", 'CH1,"Angle",DC,5V,Off,360.000,0.000,deg', "Data"]
    head += ["Number,Date&Time,ms,Angle,East,North", "NO.,Time,ms,deg,m,m"]
    clock, parts = _stamps(frame, "%Y/%m/%d %H:%M:%S"), _stamps(frame, "%L")
    rows = [
        [str(i), one, part, *(f"{float(x):+.9f}" for x in row[1:])]
        for i, (one, part, row) in enumerate(zip(clock, parts, _cells(frame), strict=True), 1)
    ]
    _put(path, head, rows, ",", end="\r\n")


def _book(path, sheet, names, rows, *above, others=None):
    write_workbook(path, (others or {}) | {sheet: [*above, names, *rows]})


def _numbers(frame):
    columns = (frame["time_s"], _degrees(frame), frame["east_m"], frame["north_m"])
    return [[float(x) for x in row] for row in zip(*columns, strict=True)]


@_file("Excel, German sheets", ".xlsx")
def _(frame, path):
    names = ["Zeit [s]", "Winkel [°]", "Ost [m]", "Nord [m]"]
    others = {"Prüfprotokoll": [["Prüfer", "Müller"], ["Datum", 46034]]}
    _book(path, "Messung 1 – Übersicht", names, _numbers(frame), others=others)


@_file("Excel, Japanese", ".xlsx")
def _(frame, path):
    above = [["遠心試験 12", None, None, None]]
    rows = [["s", "deg", "m", "m"], *_numbers(frame)]
    _book(path, "測定データ", ["時間", "角度", "東", "北"], rows, *above)


@_file("Excel, Chinese", ".xlsx")
def _(frame, path):
    names = ["时间(s)", "角度(°)", "东(m)", "北(m)"]
    _book(path, "数据", names, _numbers(frame))


@_file("Excel, text with decimal commas", ".xlsx")
def _(frame, path):
    names = ["Zeit [s]", "Winkel [°]", "Ost [m]", "Nord [m]"]
    _book(path, "Tabelle1", names, _cells(frame, mark=","))


@_file("cp1252 with a hint for Excel")
def _(frame, path):
    head = ["sep=;", "Zeit [s];Winkel [°];Ost [m];Nord [m]"]
    _put(path, head, _cells(frame, mark=","), ";", encoding="cp1252", end="\r\n")


@_file("UTF-8 with its mark")
def _(frame, path):
    _put(path, _plain(mark=";"), _cells(frame, mark=","), ";", encoding="utf-8-sig")


@_file("UTF-16 with tabs", ".txt")
def _(frame, path):
    _put(path, _plain(mark="\t"), _cells(frame, mark=","), "\t", encoding="utf-16", end="\r\n")


@_file("every cell in quotation marks")
def _(frame, path):
    head = ['"Time [s]","Angle [deg]","East [m]","North [m]"']
    rows = [[f'"{cell}"' for cell in row] for row in _cells(frame, mark=",")]
    _put(path, head, rows, ",")


def _grouped(frame, group, mark):
    columns = [1000.0 * frame["time_s"].to_numpy(), _degrees(frame)]
    columns += [1000.0 * frame[name].to_numpy() for name in ("east_m", "north_m")]
    marks = str.maketrans({",": group, ".": mark})
    return [[f"{x:,.6f}".translate(marks) for x in row] for row in zip(*columns, strict=True)]


@_file("narrow blanks between thousands")
def _(frame, path):
    _put(path, ["Temps (ms);Angle (°);Est (mm);Nord (mm)"], _grouped(frame, "\u202f", ","), ";")


@_file("blanks of cp1252 between thousands")
def _(frame, path):
    rows = _grouped(frame, "\u00a0", ",")
    _put(path, ["Zeit (ms);Winkel (°);Ost (mm);Nord (mm)"], rows, ";", encoding="cp1252")


@_file("apostrophes between thousands")
def _(frame, path):
    _put(path, ["Zeit (ms);Winkel (°);Ost (mm);Nord (mm)"], _grouped(frame, "'", "."), ";")


@_file("blanks between thousands, and Unicode's minus")
def _(frame, path):
    rows = [[cell.replace("-", "\u2212") for cell in row] for row in _grouped(frame, " ", ",")]
    _put(path, ["Temps (ms);Angle (°);Est (mm);Nord (mm)"], rows, ";")


@_file("points between thousands")
def _(frame, path):
    _put(path, ["Zeit (ms);Winkel (°);Ost (mm);Nord (mm)"], _grouped(frame, ".", ","), ";")


@_file("commas between thousands, in quotation marks")
def _(frame, path):
    rows = [[f'"{cell}"' for cell in row] for row in _grouped(frame, ",", ".")]
    _put(path, ["Time (ms),Angle (deg),East (mm),North (mm)"], rows, ",")


@_file("a clock of whole seconds beside the time")
def _(frame, path):
    rows = [
        [stamp, *row]
        for stamp, row in zip(_stamps(frame, "%Y-%m-%d %H:%M:%S"), _cells(frame), strict=True)
    ]
    _put(path, ["Timestamp,Elapsed [s],Angle [deg],East [m],North [m]"], rows, ",")


@_file("two times")
def _(frame, path):
    rows = [[f"{1768215598 + float(row[0]):.3f}", *row] for row in _cells(frame)]
    _put(path, ["Time abs [s],Time rel [s],Angle [deg],East [m],North [m]"], rows, ",")


def _angles(name, title, angle):
    def write(frame, path):
        _put(path, _plain(angle=title), _cells(frame, angle=angle(_degrees(frame))), ",")

    FILES[name] = (write, ".csv")


_angles("an angle wrapped at 180", "phi", lambda a: (a + 180.0) % 360.0 - 180.0)
_angles("gon", "phi [gon]", lambda a: a / 0.9 % 400.0)
_angles("gon without a word", "phi", lambda a: a / 0.9 % 400.0)
_angles("counts of 22 bits", "Encoder", lambda a: np.round(a / 360.0 * 2**22) % 2**22)
_angles("counts of a round number", "Encoder [cts]", lambda a: np.round(1e4 * a) % 3.6e6)
_angles("revolutions", "Phase", lambda a: a / 360.0 % 1.0)


def _times(name, title, time, ending=".csv"):
    def write(frame, path):
        _put(path, _plain(time=title, mark=";"), _cells(frame, time=time(frame), mark=","), ";")

    FILES[name] = (write, ending)


_times("ms without a word", "Time", lambda f: [str(round(1e3 * t)) for t in f["time_s"]])
_times("us without a word", "Time", lambda f: [str(round(1e6 * t)) for t in f["time_s"]])
_times("minutes", "Time [min]", lambda f: f["time_s"].to_numpy() / 60.0)
_times(
    "ms since 1970",
    "timestamp",
    lambda f: [str(1768215598000 + round(1e3 * t)) for t in f["time_s"]],
)
_times(
    "minutes and seconds",
    "Time",
    lambda f: [f"{t // 60:02.0f}:{t % 60:06.3f}" for t in f["time_s"]],
)
_times("hours, minutes and seconds", "Time", lambda f: _stamps(f, "%H:%M:%S,%L"))
_times("a German date", "Zeitstempel", lambda f: _stamps(f, "%d.%m.%Y %H:%M:%S,%L"))
_times("an American date", "Time", lambda f: _stamps(f, "%m/%d/%Y %I:%M:%S.%L %p"))
_times("a date with strokes", "Time", lambda f: _stamps(f, "%Y/%m/%d %H:%M:%S.%L"))


@_file("rates, words and temperatures beside")
def _(frame, path):
    head = ["No,Time [s],Speed [rpm],Angle [deg],East [m],North [m],Temp [°C],Status"]
    rows = [
        [str(i), t, "60.0", *more, f"{21.0 + 0.01 * i:.2f}", "OK"]
        for i, (t, *more) in enumerate(_cells(frame), 1)
    ]
    _put(path, head, rows, ",")


@_file("cells that were not measured")
def _(frame, path):
    rows = _cells(frame)
    rows[17][2], rows[55][3], rows[90][2], rows[91][2] = "OVLD", "#N/A", "---", "+9.9E37"
    _put(path, _plain(), rows, ",")


@_file("a units row of German words, and columns of the speed and the room")
def _(frame, path):
    head = ["Zeit;Drehzahl;Winkel;Ost;Nord;Temperatur", "s;1/min;Grad;m;m;°C"]
    rows = [
        [t, "60", a, e, n, f"22,3{i % 10}"]
        for i, (t, a, e, n) in enumerate(_cells(frame, mark=","))
    ]
    _put(path, head, rows, ";", encoding="cp1252", end="\r\n")


@_file("numbers of the rows before an encoder's name, letters of the axes", ".txt")
def _(frame, path):
    rows = [[str(i), *row] for i, row in enumerate(_cells(frame))]
    _put(path, ["idx time_s enc_deg dE_m dN_m"], rows, " ")


@_file("UTF-16 without its mark", ".txt")
def _(frame, path):
    _put(path, _plain(mark="\t"), _cells(frame), "\t", encoding="utf-16-le", end="\r\n")


@_file("text that is named as a workbook", ".xls")
def _(frame, path):
    _put(path, _plain(mark="\t"), _cells(frame), "\t", end="\r\n")
