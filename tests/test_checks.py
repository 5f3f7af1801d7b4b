"""What the checks of settings let pass, and the one sentence with which they refuse the rest."""

import math

import numpy as np
import pytest

from jaxshape import checks


@pytest.mark.parametrize(
    ("check", "given", "limits"),
    [
        (checks.one_of, "b", [("a", "b")]),
        (checks.whole, 1, [1]),
        (checks.whole, np.int64(7), [1]),
        (checks.whole, 3, [1, 3]),
        (checks.seed, 2**32 - 1, []),
        (checks.positive, 1e-9, []),
        (checks.positive, np.float32(2), ["metres"]),
        (checks.at_least, 0, [0]),
        (checks.within, 0.0, [0, 1]),
        (checks.within, 1, [0, 1]),
    ],
)
def test_values_in_range_pass(check, given, limits):
    check("size", given, *limits)


@pytest.mark.parametrize(
    ("check", "given", "limits", "said"),
    [
        (checks.one_of, "c", [("a", "b")], "size is 'c'; give 'a' or 'b'."),
        (checks.one_of, "a ", [iter("ab")], "size is 'a '; give 'a' or 'b'."),
        (checks.whole, 0, [1], "size is 0; give a whole number, 1 or more."),
        (checks.whole, 2.0, [1], "size is 2.0; give a whole number, 1 or more."),
        (checks.whole, True, [1], "size is True; give a whole number, 1 or more."),
        (checks.whole, 4, [1, 3], "size is 4; give a whole number, 1 to 3."),
        (checks.whole, 4, [1, 3, "so it is"], "size is 4; give a whole number, 1 to 3: so it is."),
        (checks.whole, 0, [1, 3], "size is 0; give a whole number, 1 or more."),
        (checks.seed, -1, [], "size is -1; give a whole number, 0 or more."),
        (checks.positive, 0, [], "size is 0; give a number above 0."),
        (checks.positive, math.inf, [], "size is inf; give a number above 0."),
        (checks.positive, "3", [], "size is '3'; give a number above 0."),
        (checks.positive, -1, ["metres"], "size is -1; give a number of metres above 0."),
        (checks.at_least, -0.5, [0], "size is -0.5; give a number, 0 or more."),
        (checks.at_least, math.inf, [0], "size is inf; give a number, 0 or more."),
        (checks.within, 1.5, [0, 1], "size is 1.5; give a number from 0 to 1."),
        (checks.within, math.nan, [0, 1], "size is nan; give a number from 0 to 1."),
        (checks.within, None, [0, 1], "size is None; give a number from 0 to 1."),
    ],
)
def test_other_values_are_refused_in_one_sentence(check, given, limits, said):
    with pytest.raises(ValueError) as refusal:
        check("size", given, *limits)
    assert str(refusal.value) == said
