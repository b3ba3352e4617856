"""Bayesian estimation: priors, the posterior density, Markov chains and importance sampling.

Everything here works on a :class:`~dahl_ident.problem.Problem` and returns plain numbers;
:mod:`dahl_ident.results` presents them to users.
"""
