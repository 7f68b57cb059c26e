"""Degrees and local metres: numbers of pymap3d 3.2.0."""

import numpy as np
import pytest

from torch_denkf.data.earth import to_degrees, to_local

PLACES = [
    ((51.05, 13.8, 130.0), (51.04, 13.79, 110.0), (701.2362946076444, 1112.5616522117984, 19.864437123485345)),
    ((-33.9, 151.3, 50.0), (-33.8, 151.2, 0.0), (9249.358003031672, -11096.539792928466, 33.61296641857825)),
    ((0.001, -179.999, 0.0), (0.0, 179.999, 0.0), (222.6389815114655, 110.57427581609333, -0.004850725659506477)),
    ((89.9999, 30.0, 10.0), (89.999, -60.0, 0.0), (11.169415409704328, 111.69415408619795, 9.999015536450301)),
    ((-44.63961015404319, 170.87792943424492, 3295.9815020205306), (-45.0, 170.5, 100.0), (3e4, 4e4, 3e3)),
]


@pytest.mark.parametrize(("place", "origin", "metres"), PLACES)
def test_places_in_metres_and_back(place, origin, metres):
    np.testing.assert_allclose(to_local(np.array(place), origin), metres, rtol=0, atol=1e-6)
    back = to_degrees(np.array([metres, metres]), origin)
    np.testing.assert_allclose(back[:, 0], place[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(back[1, 1:], place[1:], rtol=0, atol=1e-6)
    flat = to_local(np.array([place[:2]] * 2), origin[:2])
    np.testing.assert_allclose(to_degrees(flat, origin[:2]), [place[:2]] * 2, rtol=0, atol=1e-10)


def test_invalid_places():
    with pytest.raises(ValueError, match=r"latitude, longitude and perhaps a height, \[\*, 2 or 3\]; got \[4\]"):
        to_local(np.zeros(4), [0.0, 0.0])
