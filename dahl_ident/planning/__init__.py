"""Plan the next measurement: which levels, how many cycles, in which order.

:func:`plan` weighs what a settled level tells of the parameters against the bench time that it
takes: settling, measured cycles, change-over. It works before any data, from a model with ranges,
and after some, from a fit or a posterior.
"""

from dahl_ident.planning.measurement_plan import Plan
from dahl_ident.planning.planner import plan

__all__ = ["Plan", "plan"]
