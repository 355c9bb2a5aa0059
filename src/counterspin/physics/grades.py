"""Sizes of the terms of an accelerometer by grade, with their sources.

The credible size is an order of magnitude, several times the limit of data sheets; a larger value
indicates a mistake. The typical size is the default standard uncertainty of a term without a stated
value. Its source names the document and the figure, or states that there is none.

Documents:

- the paper: Table 1 of the paper that this package implements
- dual-use list: accelerometers controlled by entry 7A001.a of the EU and Swiss (GKV) lists of
  dual-use goods, here the Swiss list
- MS1010: Safran Colibrys, MS1000 data sheet, 2016-12-30, the ±10 g model, typical values
- ADXL350, ADXL313: Analog Devices, data sheets, Table 1
- HASI: calibration of the servo accelerometer of Huygens, ``HASI_ACC_CALIBRATION_DATA.TXT`` in
  ESA's Planetary Science Archive
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from counterspin.frozen import frozen

#: From the best to the worst.
GRADES: Final = ("navigation", "tactical", "consumer")

DEFAULT_GRADE: Final = GRADES[0]


@frozen
class Size:
    """Sizes of a term, in the unit of its row."""

    limit: float  #: The largest credible size.
    typical: float  #: Standard uncertainty to assume where nothing is known.
    source: str  #: What `typical` rests on.


_NO_SOURCE: Final = "order-of-magnitude estimate, no source"
_FIFTH_OF_K_II: Final = (
    "order-of-magnitude estimate: a fifth of K_II, the same ratio as for navigation grade"
)
_TENTH_OF_K_II: Final = (
    "order-of-magnitude estimate: a tenth of K_II, the same ratio as for navigation grade"
)
_TWENTIETH_OF_K_F: Final = (
    "order-of-magnitude estimate: a twentieth of K_F, the same ratio as for navigation grade"
)
_PAPER_SOURCE: Final = (
    "a third of K_IP in the paper's Table 1 (6e-6 g/g²); same value for the other terms"
)

_CROSS_TERM_SIZES: Final = (
    (1e-4, 2e-6, _PAPER_SOURCE),
    (1e-3, 6e-5, _FIFTH_OF_K_II),
    (1e-2, 2e-4, _FIFTH_OF_K_II),
)
_SECOND_ORDER_SOURCE: Final = "order-of-magnitude estimate: same effect as K_II at 1 g"
_PENDULUM_SIZES: Final = (
    (0.1, 1e-3, "order-of-magnitude estimate: a pendulum length of 10 mm, divided by g"),
) * 3
_MISALIGNMENT_SIZES: Final = (
    (
        1e-2,
        5e-5,
        "order-of-magnitude estimate, no source: 10 arcsec after alignment on the platform or "
        "fixture",
    ),
    (5e-2, 1e-2, "MS1010: misalignment 10 mrad"),
    (0.2, 2e-2, "value between the cross-axis sensitivities of ADXL313 (±1 %) and ADXL350 (±3 %)"),
)

#: HASI's bias has 0.6 µg/K at 293 K and 2.3 µg/K at 100 K: 4e-9 g/K^2.
_POWER_SOURCES: Final = {
    2: "order-of-magnitude estimate, no source: 1 % of the linear coefficient, per kelvin",
    3: "order-of-magnitude estimate, no source: 1 % of the quadratic coefficient, per kelvin",
}

_SIZE_ROWS: Final[Mapping[str, tuple[tuple[float, float, str], ...]]] = {
    "K_F": (
        (
            0.1,
            1e-4,
            "navigation grade (1 nautical mile per hour): a bias of 1e-4 g tilts the platform by "
            "1e-4 rad, a position error of 0.34 nautical miles; dual-use list, 7A001.a.1: "
            "better than 130 µg over one year",
        ),
        (0.3, 1.2e-3, "MS1010: long-term bias repeatability 1.2 mg"),
        (1.0, 5e-2, "ADXL350: typical 0 g output of X and Y, ±50 mg"),
    ),
    "K_I": (
        (0.1, 1e-4, "dual-use list, 7A001.a.1: scale factor better than 130 ppm over one year"),
        (
            0.2,
            1.2e-3,
            "dual-use list, 7A001.a.2, above 15 g: scale factor better than 1250 ppm over one year",
        ),
        (0.5, 4e-2, "ADXL350: 512 LSB/g ± 7.5 %, treated as limits of a rectangular distribution"),
    ),
    "K_II": (
        (1e-4, 1e-5, "half of the value in the paper's Table 1 (2e-5 g/g²)"),
        (3e-3, 3e-4, "MS1010: nonlinearity 0.3 % of 10 g, attributed entirely to second order"),
        (
            1e-2,
            1e-3,
            "ADXL313 and ADXL350: nonlinearity ±0.5 % of 4 g and of 8 g, attributed entirely to "
            "second order",
        ),
    ),
    "K_III": (
        (1e-4, 1e-6, "a quarter of the value in the paper's Table 1 (4e-6 g/g³)"),
        (1e-3, 3e-5, "MS1010: nonlinearity 0.3 % of 10 g, attributed entirely to third order"),
        (1e-2, 1e-4, "ADXL350: nonlinearity ±0.5 % of 8 g, attributed entirely to third order"),
    ),
    "K_4": ((1e-5, 1e-9, _NO_SOURCE), (1e-4, 1e-7, _NO_SOURCE), (1e-3, 1e-6, _NO_SOURCE)),
    "K_5": (
        (1e-5, 1e-8, "order-of-magnitude estimate: effect of 1 mg at 10 g, as for K_II and K_III"),
        (
            1e-4,
            3e-7,
            "MS1010: nonlinearity 0.3 % of 10 g, attributed entirely to the fifth-order term",
        ),
        (
            1e-3,
            1e-6,
            "ADXL350: nonlinearity ±0.5 % of 8 g, attributed entirely to the fifth-order term",
        ),
    ),
    "K_0_asym": (
        (1e-2, 5e-6, f"{_NO_SOURCE}: a twentieth of K_F"),
        (5e-2, 6e-5, _TWENTIETH_OF_K_F),
        (0.1, 2.5e-3, _TWENTIETH_OF_K_F),
    ),
    "K_I_asym": (
        (1e-2, 1e-5, _SECOND_ORDER_SOURCE),
        (5e-2, 3e-4, _SECOND_ORDER_SOURCE),
        (0.1, 1e-3, _SECOND_ORDER_SOURCE),
    ),
    "K_spin": _PENDULUM_SIZES,
    "K_ang": _PENDULUM_SIZES,
    "K_IP": _CROSS_TERM_SIZES,
    "K_IO": _CROSS_TERM_SIZES,
    "K_PO": _CROSS_TERM_SIZES,
    "K_PP": _CROSS_TERM_SIZES,
    "K_OO": _CROSS_TERM_SIZES,
    "K_OQ": ((1e-4, 1e-6, _NO_SOURCE), (1e-3, 3e-5, _TENTH_OF_K_II), (1e-2, 1e-4, _TENTH_OF_K_II)),
    "delta_O": _MISALIGNMENT_SIZES,
    "delta_P": _MISALIGNMENT_SIZES,
    "K_F.temperature": (
        (1e-2, 5e-6, "order-of-magnitude estimate; HASI: 0.6 µg/K at 293 K, 2.3 µg/K at 100 K"),
        (1e-2, 1e-4, _NO_SOURCE),
        (1e-2, 2e-4, "ADXL350: typical 0 g offset of ±0.17 mg/K (X, Y) and ±0.24 mg/K (Z)"),
    ),
    "K_I.temperature": (
        (1e-2, 1e-4, "HASI: 78 ppm/K at 293 K"),
        (1e-2, 1e-4, "same value as for navigation and consumer grade"),
        (1e-2, 1e-4, "ADXL313 and ADXL350: ±0.01 %/K"),
    ),
    **{
        f"{symbol}.temperature.{n}": tuple(
            (limit / 100.0 ** (n - 1), typical / 100.0 ** (n - 1), _POWER_SOURCES[n])
            for limit, typical in sizes
        )
        for symbol, sizes in (
            ("K_F", ((1e-2, 5e-6), (1e-2, 1e-4), (1e-2, 2e-4))),
            ("K_I", ((1e-2, 1e-4), (1e-2, 1e-4), (1e-2, 1e-4))),
        )
        for n in (2, 3)
    },
    "K_II.temperature": (
        (1e-5, 1e-8, _NO_SOURCE),
        (1e-4, 3e-7, _NO_SOURCE),
        (1e-3, 1e-6, _NO_SOURCE),
    ),
    "K_F.hysteresis": tuple(
        (limit, typical, "order-of-magnitude estimate, no source: effect of 4 K on K_F")
        for limit, typical in ((1e-2, 2e-5), (1e-2, 4e-4), (5e-2, 8e-4))
    ),
    "K_F.trend": (
        (1e-3, 1.7e-9, "order-of-magnitude estimate, no source: 0.1 µg/min"),
        (1e-3, 1.7e-8, "order-of-magnitude estimate, no source: 1 µg/min"),
        (1e-3, 1.7e-7, "order-of-magnitude estimate, no source: 10 µg/min"),
    ),
    "K_F.heating": ((1e-4, 1e-7, _NO_SOURCE), (1e-3, 1e-6, _NO_SOURCE), (1e-2, 1e-5, _NO_SOURCE)),
}

#: Symbol of a term of an accelerometer -> grade -> size.
SIZES: Final[Mapping[str, Mapping[str, Size]]] = {
    symbol: {grade: Size(*size) for grade, size in zip(GRADES, sizes, strict=True)}
    for symbol, sizes in _SIZE_ROWS.items()
}
