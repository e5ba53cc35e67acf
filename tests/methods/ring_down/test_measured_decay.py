"""What is said of a measured hammer test of a beam (vibrationtesting, MIT).

Its figures are in the validation manual.
"""

from __future__ import annotations

from tests.validation.modal import decayed


def test_a_damping_that_depends_on_the_amplitude_is_named() -> None:
    """A second mode fits it better than the law, but not well: the interval still holds."""
    fit = decayed((204.0, 220.0))
    assert (
        "amplitude-dependent" in [finding.code for finding in fit.findings]
        and fit.parameter("zeta_1").ci95 is not None
    )


def test_hum_is_no_mode() -> None:
    """The second harmonic of the mains: its damping ratio cannot be told from zero, and a warning says so."""
    assert {finding.code for finding in decayed((100.0, 130.0)).findings} & {"unphysical", "insignificant"}
