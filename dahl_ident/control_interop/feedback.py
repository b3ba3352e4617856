"""Plants measured under feedback: from the response to the reference to that of the plant.

With F = C (r - x) the closed loop obeys (Z(A) + C) X = C R. It is therefore equivalent to the plant
with the controller as an additional parallel element, ``LinearSystem(C,
quantity="dynamic_stiffness")``, driven by the force C R, and can be identified like any other
force-driven plant. Dividing the response by the controller instead would give data in which neither
the force nor the displacement amplitude was controlled.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import broadcast_shape, finite_array, positive_array
from dahl_ident.control_interop.linear_part import controller_response
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.quantities import jacobian
from dahl_ident.errors import ValidationError


def closed_loop_response(
    frequency_hz: ArrayLike,
    reference: ArrayLike,
    response: ArrayLike,
    controller: Any,
    *,
    covariance: ArrayLike | None = None,
) -> FrequencyResponse:
    """Return X/(C R) over the drive abs(C) r_0, from the closed loop's X/R.

    Parameters
    ----------
    frequency_hz : array_like, shape (n,)
        Hz, > 0.
    reference : array_like, shape (n,) or one number
        Zero-to-peak reference r_0 > 0, m.
    response : array_like of complex, shape (n,)
        X/R, displacement over reference.
    controller : control.TransferFunction, control.StateSpace or control.FRD
        C in F = C (r - x), N/m.
    covariance : array_like, shape (n, 2, 2), optional
        Of the real and imaginary part of `response`.

    Returns
    -------
    FrequencyResponse
        Receptance rows, controlled by force, one level for each reference. Fit a model that
        holds the controller: ``plant + LinearSystem(controller, quantity="dynamic_stiffness")``.

    Raises
    ------
    ValidationError
        If a frequency or reference is not above zero, shapes do not go together, or the
        controller is zero at a frequency.

    Examples
    --------
    >>> import control
    >>> from dahl_ident.control_interop import closed_loop_response
    >>> pd = control.tf([2.0, 100.0], [1.0])
    >>> data = closed_loop_response([1.0, 2.0], 1e-3, [0.9 - 0.1j, 0.8 - 0.3j], pd)
    >>> data.quantity, data.drive.round(4).tolist()
    ('receptance', [0.1008, 0.1031])
    """
    f = positive_array(frequency_hz, "frequency_hz")
    r = positive_array(reference, "reference")
    X_over_R = np.asarray(response, dtype=np.complex128)
    broadcast_shape(frequency_hz=f, reference=r, response=X_over_R)
    omega = 2.0 * np.pi * f
    C = controller_response(controller, omega)
    if np.any(C == 0.0):
        raise ValidationError(
            f"the controller is 0 at {f[C == 0.0][0]:g} Hz, where nothing drives the plant; "
            "leave that frequency out"
        )
    turned = None
    if covariance is not None:
        turn = jacobian(1.0 / C)
        turned = turn @ finite_array(covariance, "covariance") @ np.swapaxes(turn, -1, -2)
    return FrequencyResponse(
        f,
        X_over_R / C,
        drive=np.abs(C) * r,
        covariance=turned,
        level=np.broadcast_to(r, f.shape),
        controlled="force",
        quantity="receptance",
    )
