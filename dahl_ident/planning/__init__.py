"""Plan the next measurement: which levels, how many cycles, in which order.

:func:`plan` weighs the information in a settled level against the bench time that it takes:
settling, measured cycles, change-over; motions in time are weighed by their duration. It works
before any data, from a model with ranges, and after some data, from a fit or a posterior.
"""

from dahl_ident.planning.measurement_plan import Plan
from dahl_ident.planning.planner import plan
from dahl_ident.planning.trajectories import Multisine, Trapezoid

__all__ = ["Multisine", "Plan", "Trapezoid", "plan"]
