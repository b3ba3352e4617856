"""An independent sampler agrees; ``make nuts`` is the long version."""

import pytest

pytest.importorskip("numpyro", reason="the extra nuts is not installed")


def test_nuts_finds_the_same_posterior():
    from benchmarks.nuts import compare

    for what, ours, theirs, apart in compare(draws=1000, ess=2000.0):
        assert abs(apart) < 4.0, (what, ours, theirs)
