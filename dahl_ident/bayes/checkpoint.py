"""Chains on disk that survive a crash.

One HDF5 file holds all steps and the state of the random numbers. It is first written to a
temporary file in the same folder, flushed to the disk and renamed, so that the file is complete at
every moment, whatever happens to the process. A run spends at most about a twentieth of its time
writing. While it runs, it holds a lock on ``<file>.lock``; a second run on the same file is
refused. (On Windows there is no such lock: do not start two runs on one file.)

A file is resumed only if it belongs to the same data, model, priors and settings, and if its digest
shows that it is unchanged; any other file is refused and not modified.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident.bayes.chain import Chain, ChainSettings, Convergence
from dahl_ident.bayes.density import LogDensity
from dahl_ident.data.storage import library, locked, path_of, plain_data, put_in_place
from dahl_ident.elements.element import describe_model
from dahl_ident.errors import ModelError, SamplingError

_FORMAT = "dahl_ident chain", 1  # name and version of the layout; any other is refused
_ARRAYS = ("points", "log_density", "start", "random_key", "random_rest")
_SAMPLING_PER_WRITING = 20.0  # ratio of their times

Identity = Mapping[str, str]
"""Everything a chain depends on, part by part, as text or digest."""


def identity(density: LogDensity, settings: ChainSettings) -> Identity:
    """Return everything a chain depends on except its seed, part by part."""
    elements = density.problem.model
    try:
        model = json.dumps(describe_model(elements), sort_keys=True, default=str)
    except ModelError:  # a linear system built by a function
        model = repr(elements)
    facts = {
        name: part if isinstance(part, str) else _digest(*part)
        for name, part in density.facts.items()
    }
    return {
        **facts,
        "model": model,
        "likelihood": density.likelihood,
        "parameters": ", ".join(density.names),
        "walkers": f"{settings.walkers} in {settings.ensembles} ensembles",
        **{f"prior of {name}": text for name, text in density.priors.items()},
    }


class ChainFile:
    """The file of one run, for which :func:`open_chain` holds the lock.

    As a listener of :func:`dahl_ident.bayes.chain.run` it writes at intervals, to limit the cost.
    """

    def __init__(self, path: Path, identity: Identity) -> None:
        self.path, self._identity = path, identity
        self._written: Chain | None = None
        self._latest: Chain | None = None
        self._due = 0.0

    def load(self) -> Chain | None:
        """Return the chain in the file; None if there is no file yet."""
        if not self.path.exists():
            return None
        chain, stored = _read(self.path)
        differing = [k for k, v in self._identity.items() if stored.get(k) != v]
        if differing:
            raise SamplingError(
                f"{self.path} holds a chain of another run: it differs in "
                f"{', '.join(differing)}. Resume with the original settings, or give another "
                "file; this one was not changed"
            )
        self._written = self._latest = chain
        return chain

    def __call__(self, chain: Chain, verdict: Convergence | None) -> None:
        """Keep the chain, and write it if the last write is long enough ago."""
        self._latest = chain
        if time.monotonic() >= self._due:
            self.flush()

    def flush(self) -> None:
        """Write the latest chain, unless the file already holds it."""
        if self._latest is None or self._latest is self._written:
            return
        began = time.monotonic()
        _write(self.path, self._latest, self._identity)
        self._written = self._latest
        ended = time.monotonic()
        self._due = ended + _SAMPLING_PER_WRITING * (ended - began)


@contextmanager
def open_chain(path: str | os.PathLike[str], identity: Identity) -> Iterator[ChainFile]:
    """Lock a chain's file for the duration of a run; write the last steps at its end."""
    file = path_of(path, "resume")
    if file.is_dir():
        raise SamplingError(f"{file} is a folder; give the path of a file in it")
    if not file.parent.is_dir():
        raise SamplingError(f"{file.parent} is not a folder; make it, or give another path")
    with locked(file, SamplingError):
        chain_file = ChainFile(file, identity)
        try:
            yield chain_file
        finally:
            chain_file.flush()


def _write(path: Path, chain: Chain, identity: Identity) -> None:
    h5py = library("h5py")
    _, key, *position = chain.random_state
    values = (chain.points, chain.log_density, chain.start, key, np.array(position, dtype=float))
    text = json.dumps(dict(identity), sort_keys=True)
    seed = str(chain.seed)

    def write(place: Path) -> None:
        with h5py.File(place, "w") as file:
            for name, array in zip(_ARRAYS, values, strict=True):
                file[name] = array
            digest = _digest(text, seed, *values)
            format_, version = _FORMAT
            file.attrs.update(
                format=format_, version=version, identity=text, seed=seed, digest=digest
            )

    try:
        put_in_place(path, write)
    except (OSError, RuntimeError) as exc:  # h5py raises either, with the library's own words
        why = os.strerror(exc.errno) if isinstance(exc, OSError) and exc.errno else str(exc)
        raise SamplingError(
            f"{path}: the chain cannot be written: {why}; the previous content of the file is "
            "unchanged"
        ) from exc


def _read(path: Path) -> tuple[Chain, dict[str, str]]:
    """Return the chain in a file, and its identity."""
    h5py = library("h5py")
    try:
        with h5py.File(path, "r") as file:
            attributes = plain_data(dict(file.attrs))
            stated = (attributes.get("format"), attributes.get("version"))
            readable = stated == _FORMAT and {"identity", "seed", "digest"} <= set(attributes)
            values = [file[name][()] for name in _ARRAYS] if readable else []
    except (OSError, KeyError, RuntimeError, TypeError) as exc:
        raise SamplingError(
            f"{path} cannot be read as a chain ({exc}); it is damaged or of another kind. Give "
            "another file; this one was not changed"
        ) from exc
    if not readable:
        raise SamplingError(
            f"{path} is an HDF5 file, but not a chain that this version can resume: format and "
            f"version are {stated}, expected {_FORMAT}. Give another file; this one was not changed"
        )
    text, seed = attributes["identity"], attributes["seed"]
    if _digest(text, seed, *values) != attributes["digest"]:
        raise SamplingError(
            f"{path} is damaged: its content does not match the digest that was written with it. "
            "Give another file, or an undamaged copy; this one was not changed"
        )
    points, log_density, start, key, position = values
    place, has_gauss, cached = position.tolist()
    state = ("MT19937", key, int(place), int(has_gauss), cached)
    return Chain(int(seed), points, log_density, start, state), json.loads(text)


def _digest(*parts: Any) -> str:
    total = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, np.ndarray) and part.dtype.kind in "fciu":
            total.update(f"{part.dtype}{part.shape}".encode())
            total.update(np.ascontiguousarray(part).data)
        else:
            plain = part.tolist() if isinstance(part, np.ndarray) else part
            total.update(repr(plain).encode())
    return total.hexdigest()
