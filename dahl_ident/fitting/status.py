"""The outcome of a search, as the sentence that the user reads."""

from __future__ import annotations

from enum import Enum


class Status(Enum):
    """The outcome of a search; the value is what a report says about it."""

    CONVERGED = "Converged: the sum of squares has a minimum here, inside all bounds."
    AT_BOUND = (
        "Converged with a parameter at its bound: the sum of squares falls beyond it, so the "
        "interval is one-sided. Widen the bound, or fix the parameter."
    )
    SINGULAR = (
        "Converged, but the data leave a combination of the parameters undetermined: it can "
        "change without any change of the prediction. Fix one of the parameters involved, or "
        "give it a prior."
    )
    MICROSLIP = (
        "No finite optimum: the fit improves as f_max grows without bound at constant "
        "sigma^2/f_max, while the spring takes sigma's place. No amplitude reaches slip: drive "
        "harder, or measure the spring and fix it."
    )
    NO_LOSS = (
        "No finite optimum: the fit improves as f_max grows without bound at constant sigma. The "
        "data show the stiffness of friction but no loss: drive harder, or reduce the noise."
    )
    GROSS_SLIP = (
        "No finite optimum: the fit improves as sigma grows without bound at constant f_max. The "
        "data show slip only: use smaller amplitudes, or reduce the noise."
    )
    SHARP_KNEE = (
        "No finite optimum: the fit improves as alpha tends to zero. Friction turns from stiffness "
        "to slip more sharply than the data resolve: measure more amplitudes near the knee, or fix "
        "alpha."
    )
    NO_FULL_SLIP = (
        "No finite optimum: the fit improves as alpha and f_max grow without bound at constant "
        "f_max/alpha. The data show no limit of the friction force: drive harder, or fix alpha."
    )
    NO_FRICTION = (
        "No finite optimum: the fit improves as friction vanishes. The other elements explain "
        "the data: use smaller amplitudes, or leave the element out."
    )
    RUNS_AWAY = (
        "No finite optimum: the fit improves as a parameter goes to a limit. The amplitudes do not "
        "reach what it describes: measure where its effect is larger, or fix it."
    )
    NOT_CONVERGED = (
        "Not converged: the search stopped before it found a minimum. The numbers are not an "
        "optimum: give a start, or fix a parameter."
    )

    @property
    def outcome(self) -> str:
        """The outcome without its meaning: the status up to its colon."""
        return self.value.partition(":")[0]

    @property
    def found_optimum(self) -> bool:
        """Whether the estimate is a finite optimum."""
        return self in (Status.CONVERGED, Status.AT_BOUND)

    @property
    def at_infinity(self) -> bool:
        """Whether the optimum lies at infinite or vanishing parameters."""
        return self in _AT_INFINITY


_AT_INFINITY = (
    Status.MICROSLIP,
    Status.NO_LOSS,
    Status.GROSS_SLIP,
    Status.SHARP_KNEE,
    Status.NO_FULL_SLIP,
    Status.NO_FRICTION,
    Status.RUNS_AWAY,
)
