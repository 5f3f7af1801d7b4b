"""The comparison of networks that fill the hidden half runs in small, and its settings are fair."""

import hidden_half


def test_networks_are_compared_on_the_same_pairs():
    networks = hidden_half.NETWORKS.values()
    for name in ("inputs", "batch", "seed", "optimizer", "average", "occluded_weight"):
        assert len({str(getattr(one, name)) for one in networks}) == 1, name


def test_the_table_has_a_line_for_each_network_and_stage():
    one = {"decoded": 0.5, "composed": 0.625, "occluded": 0.25}
    stages = {"a": {"first code": one, "searched": one}, "b": {"searched": one}}
    means = {"some camera": {str(k): stages for k in hidden_half.FRAMES}}
    lines = hidden_half.table(means).splitlines()
    assert len(lines) == 4 and lines[0].startswith("some camera")
    assert [line.split(",")[0].strip() for line in lines[1:]] == ["a", "a", "b"]
    assert lines[1].count("0.625") == len(hidden_half.FRAMES)
