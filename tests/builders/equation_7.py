"""The products of Eq. 7, written by hand."""

# Eq. 7 extended to IEEE Std 1293, by hand: value of each signed product at (i, p, o) of an
# instrument that does not rotate.
EQUATION_7 = {
    "K_F": lambda i, p, o: 1.0,
    "K_I": lambda i, p, o: i,
    "K_II": lambda i, p, o: i * i,
    "K_III": lambda i, p, o: i * i * i,
    "K_4": lambda i, p, o: i**4,
    "K_5": lambda i, p, o: i**5,
    "K_IP": lambda i, p, o: i * p,
    "K_IO": lambda i, p, o: i * o,
    "K_PO": lambda i, p, o: p * o,
    "K_PP": lambda i, p, o: p * p,
    "K_OO": lambda i, p, o: o * o,
    "K_OQ": lambda i, p, o: i * abs(i),
    "K_0_asym": lambda i, p, o: 0.5 * ((i > 0.0) * 1.0 - (i < 0.0) * 1.0),
    "K_I_asym": lambda i, p, o: 0.5 * abs(i),
    "K_spin": lambda i, p, o: 0.0,
    "K_ang": lambda i, p, o: 0.0,
    "delta_O": lambda i, p, o: p,
    "delta_P": lambda i, p, o: -o,
}
