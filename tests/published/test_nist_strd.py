"""NIST Statistical Reference Datasets, linear regression: Pontius, Longley, Filip.

Source: NIST/ITL StRD, Linear Least Squares Regression, certified values to 15 digits,
https://www.itl.nist.gov/div898/strd/lls/lls.shtml. The agreement is measured as there, by the log
relative error LRE = -log10(|computed - certified| / |certified|), the number of right digits.
"""

import numpy as np
import pytest

from counterspin.inference.plain_fit import fit


def numbers(table):
    """The numbers of a text, in order."""
    return np.array([float(word) for word in table.split()])


def digits(computed, certified):
    """Right digits, at most the 15 that are certified."""
    error = np.abs(np.asarray(computed) - certified) / np.abs(certified)
    return -np.log10(np.maximum(error, 1e-15))


class TestPontius:
    """Load cell calibration, quadratic in the load; lower level of difficulty."""

    LOAD = np.tile(np.arange(150_000.0, 3_000_001.0, 150_000.0), 2)
    DEFLECTION = numbers(
        """
        .11019 .21956 .32949 .43899 .54803 .65694 .76562 .87487 .98292 1.09146
        1.20001 1.30822 1.41599 1.52399 1.63194 1.73947 1.84646 1.95392 2.06128 2.16844
        .11052 .22018 .32939 .43886 .54798 .65739 .76596 .87474 .98300 1.09150
        1.20004 1.30818 1.41613 1.52408 1.63159 1.73965 1.84696 1.95445 2.06177 2.16829
        """
    )

    def test_certified_values(self):
        result = fit(np.vander(self.LOAD, 3, increasing=True), self.DEFLECTION)
        certified = [0.673565789473684e-03, 0.732059160401003e-06, -0.316081871345029e-14]
        deviations = [0.107938612033077e-03, 0.157817399981659e-09, 0.486652849992036e-16]
        assert digits(result.estimate, certified).min() > 11.0
        assert digits(result.u, deviations).min() > 12.0
        assert digits(result.sigma, 0.205177424076185e-03) > 12.0
        assert digits(result.chi2, 0.155761768796992e-05) > 12.0
        assert result.dof == 37


class TestLongley:
    """Six economic indicators, nearly collinear; higher level of difficulty."""

    # employment; deflator, GNP, unemployed, armed forces, population, year
    DATA = numbers(
        """
        60323 83.0 234289 2356 1590 107608 1947
        61122 88.5 259426 2325 1456 108632 1948
        60171 88.2 258054 3682 1616 109773 1949
        61187 89.5 284599 3351 1650 110929 1950
        63221 96.2 328975 2099 3099 112075 1951
        63639 98.1 346999 1932 3594 113270 1952
        64989 99.0 365385 1870 3547 115094 1953
        63761 100.0 363112 3578 3350 116219 1954
        66019 101.2 397469 2904 3048 117388 1955
        67857 104.6 419180 2822 2857 118734 1956
        68169 108.4 442769 2936 2798 120445 1957
        66513 110.8 444546 4681 2637 121950 1958
        68655 112.6 482704 3813 2552 123366 1959
        69564 114.2 502601 3931 2514 125368 1960
        69331 115.7 518173 4806 2572 127852 1961
        70551 116.9 554894 4007 2827 130081 1962
        """
    ).reshape(16, 7)

    def test_certified_values(self):
        design = np.column_stack([np.ones(16), self.DATA[:, 1:]])
        result = fit(design, self.DATA[:, 0])
        certified = [
            -3482258.63459582,
            15.0618722713733,
            -0.358191792925910e-01,
            -2.02022980381683,
            -1.03322686717359,
            -0.511041056535807e-01,
            1829.15146461355,
        ]
        deviations = [
            890420.383607373,
            84.9149257747669,
            0.334910077722432e-01,
            0.488399681651699,
            0.214274163161675,
            0.226073200069370,
            455.478499142212,
        ]
        assert digits(result.estimate, certified).min() > 10.0
        assert digits(result.u, deviations).min() > 10.5
        assert digits(result.sigma, 304.854073561965) > 11.0
        assert digits(result.chi2, 836424.055505915) > 11.0
        assert result.dof == 9


class TestFilip:
    """A polynomial of degree 10 at x from -9 to -3; higher level of difficulty.

    The columns' condition number is 5e9 even when they are scaled, so that of the 16 digits of a
    double some 7 are left, by the best algorithm.
    """

    DATA = numbers(
        """
        0.8116 -6.860120914 0.9072 -4.324130045 0.9052 -4.358625055 0.9039 -4.358426747
        0.8053 -6.955852379 0.8377 -6.661145254 0.8667 -6.355462942 0.8809 -6.118102026
        0.7975 -7.115148017 0.8162 -6.815308569 0.8515 -6.519993057 0.8766 -6.204119983
        0.8885 -5.853871964 0.8859 -6.109523091 0.8959 -5.79832982 0.8913 -5.482672118
        0.8959 -5.171791386 0.8971 -4.851705903 0.9021 -4.517126416 0.909 -4.143573228
        0.9139 -3.709075441 0.9199 -3.499489089 0.8692 -6.300769497 0.8872 -5.953504836
        0.89 -5.642065153 0.891 -5.031376979 0.8977 -4.680685696 0.9035 -4.329846955
        0.9078 -3.928486195 0.7675 -8.56735134 0.7705 -8.363211311 0.7713 -8.107682739
        0.7736 -7.823908741 0.7775 -7.522878745 0.7841 -7.218819279 0.7971 -6.920818754
        0.8329 -6.628932138 0.8641 -6.323946875 0.8804 -5.991399828 0.7668 -8.781464495
        0.7633 -8.663140179 0.7678 -8.473531488 0.7697 -8.247337057 0.77 -7.971428747
        0.7749 -7.676129393 0.7796 -7.352812702 0.7897 -7.072065318 0.8131 -6.774174009
        0.8498 -6.478861916 0.8741 -6.159517513 0.8061 -6.835647144 0.846 -6.53165267
        0.8751 -6.224098421 0.8856 -5.910094889 0.8919 -5.598599459 0.8934 -5.290645224
        0.894 -4.974284616 0.8957 -4.64454848 0.9047 -4.290560426 0.9129 -3.885055584
        0.9209 -3.408378962 0.9219 -3.13200249 0.7739 -8.726767166 0.7681 -8.66695597
        0.7665 -8.511026475 0.7703 -8.165388579 0.7702 -7.886056648 0.7761 -7.588043762
        0.7809 -7.283412422 0.7961 -6.995678626 0.8253 -6.691862621 0.8602 -6.392544977
        0.8809 -6.067374056 0.8301 -6.684029655 0.8664 -6.378719832 0.8834 -6.065855188
        0.8898 -5.752272167 0.8964 -5.132414673 0.8963 -4.811352704 0.9074 -4.098269308
        0.9119 -3.66174277 0.9228 -3.2644011
        """
    ).reshape(82, 2)
    CERTIFIED = np.array(
        [
            [-1467.48961422980, 298.084530995537],
            [-2772.17959193342, 559.779865474950],
            [-2316.37108160893, 466.477572127796],
            [-1127.97394098372, 227.204274477751],
            [-354.478233703349, 71.6478660875927],
            [-75.1242017393757, 15.2897178747400],
            [-10.8753180355343, 2.23691159816033],
            [-1.06221498588947, 0.221624321934227],
            [-0.670191154593408e-01, 0.142363763154724e-01],
            [-0.246781078275479e-02, 0.535617408889821e-03],
            [-0.402962525080404e-04, 0.896632837373868e-05],
        ]
    )

    def test_certified_values(self):
        result = fit(np.vander(self.DATA[:, 1], 11, increasing=True), self.DATA[:, 0])
        assert digits(result.estimate, self.CERTIFIED[:, 0]).min() > 6.5
        assert digits(result.u, self.CERTIFIED[:, 1]).min() > 6.5
        assert digits(result.sigma, 0.334801051324544e-02) > 7.0
        assert result.dof == 71

    def test_the_same_polynomial_about_the_middle(self):
        # Centred and scaled, the same problem is a kind one: the fit itself is well determined.
        x = self.DATA[:, 1]
        centred = fit(np.vander((x + 6) / 3, 11, increasing=True), self.DATA[:, 0])
        assert digits(centred.sigma, 0.334801051324544e-02) > 12.0
        assert centred.chi2 == pytest.approx(71 * 0.334801051324544e-02**2, rel=1e-12)
