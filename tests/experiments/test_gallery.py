"""Which chairs the gallery shows, and whom it thanks."""

import numpy as np

from cad_seats import LISTS, read_list
from gallery import at_percentiles, credit
from study import Subject


def test_chairs_are_those_at_the_percentiles():
    gains = np.random.default_rng(0).permutation(101) / 100
    chosen = at_percentiles(gains.tolist())
    assert {p: gains[i] for p, i in chosen.items()} == {25: 0.25, 50: 0.5, 75: 0.75}


def test_few_chairs_are_shown_once_and_one_is_the_median():
    assert at_percentiles([0.3]) == {50: 0}
    for n in range(2, 6):
        chosen = at_percentiles(list(range(n)))
        assert 50 in chosen and len(set(chosen.values())) == len(chosen) >= 2


def test_seats_are_credited():
    seat = read_list(LISTS["seats"])[0]
    told = credit(Subject(seat.name, "CAD", 0))
    assert seat.creator in told and seat.licence in told
