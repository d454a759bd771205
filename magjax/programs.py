"""Programs that outlive the process: traced once, kept beside the compiler's cache, read and not traced again.

Tracing a fit's program in Python takes longer than to read it compiled and to run it, and a diagnosis asks for some hundred. A program is
known by its function, the structure, shapes and constants of its arguments, and the versions of jax and of this project's files; one
that holds a class from elsewhere (an effect in a notebook, which may change under its name) is not kept. Without a folder
(`jax_compilation_cache_dir`) everything is as `equinox.filter_jit` has it.
"""

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import importlib
import importlib.util
import json
import os
import sys
import threading
import zlib
from pathlib import Path

import equinox as eqx
import jax
import jaxlib
import numpy as np

MOST = 300_000_000  # bytes on disk; beyond, those that were used longest ago go
OWN = ("magjax", "fitting")
IN_MEMORY: list[tuple] = []  # the programs of every function, and whether they last
COMPILING = threading.RLock()  # one heavy program at a time: to compile it takes up to a gigabyte
COMPILER = {"xla_cpu_use_fusion_emitters": False}  # with them a program takes twice as long to compile, and runs no faster
HASTY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # a third of the time to compile
HEAVY = 77_000  # bytes of what is compiled, more than the plain chain's programs have


def kept(function, hasty: bool = False, lasting: bool = False):
    """As `equinox.filter_jit`, for a function of modules, arrays and constants that returns arrays in tuples, lists, dicts and modules.

    `hasty`: compiled without optimizing, for what runs a few times. `lasting`: small, and asked for again and again: stays in memory
    where others are let go.
    """
    within, known, locks = eqx.filter_jit(function), {}, {}
    alone = functools.cache(lambda: eqx.filter_jit(function, compiler_options=compiler_options(hasty)))
    IN_MEMORY.append((known, lasting))

    @functools.wraps(function)
    def call(*arguments):
        folder = jax.config.jax_compilation_cache_dir
        arrays, constants = eqx.partition(arguments, lambda x: isinstance(x, jax.Array | np.ndarray))
        leaves, tree = jax.tree.flatten(arrays)
        if any(isinstance(x, jax.core.Tracer) for x in leaves):
            return within(*arguments)
        if not folder:
            return alone()(*arguments)
        values, other = jax.tree.flatten(constants)
        key = (tree, other, tuple(values), tuple((x.shape, str(x.dtype)) for x in leaves))
        program = known.get(key)  # another thread may `forget` it
        if program is None:
            with locks.setdefault(key, threading.Lock()):  # a second thread waits until it is compiled
                program = known.get(key)
                if program is None:
                    program = _program(function, arguments, constants, key, leaves, Path(folder) / "programs", hasty)
                    with COMPILING if program and program.heavy else contextlib.nullcontext():
                        found = program(leaves) if program else alone()(*arguments)
                    trim()
                    known[key] = program
                    return found
        return program(leaves) if program else alone()(*arguments)

    return call


seldom = functools.partial(kept, hasty=True)
often = functools.partial(kept, hasty=True, lasting=True)


@functools.cache
def compiler_options(hasty: bool = False) -> dict:
    """`COMPILER`, with `HASTY` where asked for, as far as this machine's compiler knows them."""
    known = {}
    for options in (COMPILER, HASTY) if hasty else (COMPILER,):
        with contextlib.suppress(Exception):
            jax.jit(lambda x: x, compiler_options=options).lower(0.0).compile()
            known |= options
    return known


def forget(wanted=None) -> None:
    """Drop programs from memory, but lasting ones and those that are `wanted`, by the classes of their modules, or all of them; they are
    read again where they are asked for."""
    for known, lasting in IN_MEMORY:
        if wanted is not None and lasting:
            continue
        for key, program in tuple(known.items()):
            if not (program and wanted is not None and wanted(program.kinds)):
                known.pop(key, None)


def trim() -> None:
    """Give memory that was freed back to the system: glibc keeps what threads have freed."""
    if sys.platform == "linux":
        trimmed = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trimmed is not None:
            trimmed(0)


def _program(function, arguments, constants, key, leaves, folder, hasty):
    """The program as a function of the leaves, read or traced; False where it cannot be kept."""
    kinds = set()
    jax.tree.flatten(arguments, is_leaf=lambda x: isinstance(x, eqx.Module) and kinds.add(type(x)))
    said = f"{function.__module__}.{function.__qualname__} {key} {jax.default_backend()} {jax.config.jax_enable_x64} {_versions()}"
    if not {_home(kind) for kind in kinds} <= set(OWN) or " at 0x" in said:
        return False
    path = folder / f"{hashlib.sha256(said.encode()).hexdigest()}.program"
    try:
        form, exported = _read(path)
    except Exception:  # not there, cut short, of another make
        try:
            form, exported = _traced(function, constants, key[0], leaves)
            lasting = zlib.compress(json.dumps(form).encode() + b"\n" + bytes(exported.serialize()), 1)
        except Exception:  # something in it has no lasting form
            return False
        _write(path, lasting)
    return _Program(form, exported, frozenset(kinds), compiler_options(hasty))


class _Program:
    """A program as a function of the leaves, compiled where it is first called; it holds what was compiled by itself, and so
    outlives `jax.clear_caches`.

    `kinds`: the classes of modules among its arguments; `heavy`: whether to compile it takes much memory.
    """

    def __init__(self, form, exported, kinds, options):
        self.form, self.exported, self.kinds, self.options = form, exported, kinds, options
        self.heavy, self.run = len(exported.mlir_module_serialized) > HEAVY, None

    def __call__(self, leaves):
        if self.run is None:
            # on one device whatever the arguments come from: else each mixture of new arrays and results is compiled anew
            device = jax.config.jax_default_device or jax.local_devices()[0]
            lazy = jax.jit(self.exported.call, in_shardings=jax.sharding.SingleDeviceSharding(device), compiler_options=self.options)
            self.run = lazy.lower(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves)).compile()
            self.exported = None
        with jax.ensure_compile_time_eval():  # also where another program is traced meanwhile, for which this is a constant
            return _filled(self.form, jax.tree.leaves(self.run(*leaves)))


def _traced(function, constants, tree, leaves):
    """The form of what it returns, and the program."""
    from jax import export  # an old jax asks for a package here that it does not install

    returned = []

    def flat(*leaves):
        arrays, form = jax.tree.flatten(function(*eqx.combine(jax.tree.unflatten(tree, leaves), constants)))
        returned.append(form)  # by itself: a program whose results stand in modules has no lasting form
        return arrays

    exported = export.export(jax.jit(flat))(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves))
    return _form(jax.tree.unflatten(returned[-1], range(returned[-1].num_leaves))), exported


def _form(tree):
    """The structure in JSON, numbers for arrays; `TypeError` for what has none."""
    if tree is None or isinstance(tree, int):
        return tree
    if type(tree) in (tuple, list):
        return [type(tree).__name__, *map(_form, tree)]
    if type(tree) is dict and all(isinstance(k, str) for k in tree):
        return {"": None, **{k: _form(v) for k, v in tree.items()}}
    if isinstance(tree, eqx.Module) and _home(type(tree)) in OWN:
        fields = {f.name: _form(getattr(tree, f.name)) for f in dataclasses.fields(tree)}
        return {"": f"{type(tree).__module__}:{type(tree).__qualname__}", **fields}
    raise TypeError(f"a kept program cannot return {type(tree).__name__}")


def _filled(form, values):
    """The `_form` with the program's values."""
    if form is None or isinstance(form, int):
        return None if form is None else values[form]
    if isinstance(form, list):
        return (tuple if form[0] == "tuple" else list)(_filled(f, values) for f in form[1:])
    fields = {k: _filled(f, values) for k, f in form.items() if k}
    if form[""] is None:
        return fields
    module, name = form[""].split(":")
    return getattr(importlib.import_module(module), name)(**fields)


def _home(kind) -> str:
    """The package that a class comes from."""
    return kind.__module__.split(".")[0]


def _read(path):
    from jax import export

    form, program = zlib.decompress(path.read_bytes()).split(b"\n", 1)
    os.utime(path)
    _find_lapack()
    return json.loads(form), export.deserialize(bytearray(program))


@functools.cache
def _find_lapack() -> None:
    """Let jax look up LAPACK, which it does where an operation of it is lowered; a program that was lowered in another process would
    call a null pointer."""
    jax.jit(jax.numpy.linalg.inv).lower(jax.ShapeDtypeStruct((1, 1), float))


def _write(path, content: bytes) -> None:
    """Whole or not at all; without a word where there is no room: the next process traces anew."""
    partial = path.with_suffix(f".{os.getpid()}.{threading.get_ident()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content)
        partial.replace(path)
        if _WRITTEN.of(path.parent, len(content)):
            _make_room(path.parent)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()


class _Written(dict):
    """Bytes written to each folder since room was made there."""

    def of(self, folder, more: int) -> bool:
        """Whether room is to be made once more: at first, and after a twentieth of what there is; to look at thousands of files takes its time."""
        self[folder] = self.get(folder, MOST) + more
        due = self[folder] > MOST / 20
        if due:
            self[folder] = 0
        return due


_WRITTEN = _Written()


def _make_room(folder) -> None:
    """Let those go that were used longest ago, until what is left takes less than MOST."""
    there = sorted((f.stat().st_mtime, f.stat().st_size, f) for f in folder.glob("*.program"))
    over = sum(size for _, size, _ in there) - MOST
    for _, size, path in there:
        if over <= 0:
            break
        path.unlink(missing_ok=True)
        over -= size


@functools.cache
def _versions() -> str:
    """Of jax and equinox, and of every file of this project."""
    roots = [Path(importlib.util.find_spec(name).origin).parent for name in OWN]
    files = [f for root in roots for f in sorted(root.rglob("*.py"))]
    source = hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()
    return f"{jax.__version__} {jaxlib.__version__} {eqx.__version__} {source}"
