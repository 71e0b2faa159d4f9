"""The house rules, read from the syntax trees: no mechanism's name outside its room, and arrows one way."""

import ast
import json
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

import cannoise_jax
from cannoise_jax.mechanisms import RECORDS
from cannoise_jax.vocabulary import CLASSES
from tests.discovery.looks import SIGNATURES

PACKAGE = Path(cannoise_jax.__file__).parent
NAMED = (
    "mechanisms",
    "blind",
    "physics/core/presets.py",
    "physics/synthetic/prior.py",
    "physics/synthetic/virtual.py",
)
"""Where the name of a mechanism may stand: its own room, the injectors, and cameras made of named parts."""
NAMES = frozenset(RECORDS) - frozenset(CLASSES)  # a class of mechanisms is called as one of them is
FLOORS = (
    ("vocabulary", "exports"),
    ("recordings", "physics", "physics.hidden_level", "physics.robust"),
    ("physics.core",),
    (
        "physics.likelihood",
        "physics.transfer",
        "physics.synthetic",
        "physics.initial_noise",
        "physics.single_image",
    ),
    ("signatures", "networks"),
    ("mechanisms", "sampling", "model_file"),
    ("evaluation", "tiles"),
    ("discovery.frames",),
    ("discovery.search",),
    ("discovery.compare",),
    ("discovery.proof",),
    ("discovery.result", "training", "blind"),
    ("discovery.report",),
    ("discovery.diagnose", "discovery"),
    ("trials", "bench", "commands", ""),
)
"""From the ground up: a room imports from its own floor and those below. The package itself has all else
imported on first use, and says so to the core."""


ON_FIRST_USE = ("cannoise_jax",)
BY_STRINGS = ("cannoise_jax.exports", "cannoise_jax.mechanisms.outside", "cannoise_jax.commands.start")
"""Modules that import what strings name: those of `ON_FIRST_USE`, a user's, and one of the commands."""


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def modules() -> dict[str, Path]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports(module: str, types: bool = False) -> frozenset[str]:
    """Modules of the package that a module imports, inside functions too, and those that it has imported on
    first use, which strings name; those for type checking alone only where they are asked for."""
    found = {
        f"{module}.{n.value}"
        for n in ast.walk(tree(modules()[module]))
        if isinstance(n, ast.Constant) and module in ON_FIRST_USE
    }

    def visit(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test) and not types:
                continue
            if isinstance(child, ast.Import):
                found.update(alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module:
                for alias in child.names:
                    inner = f"{child.module}.{alias.name}"
                    found.add(inner if inner in modules() else child.module)
            visit(child)

    visit(tree(modules()[module]))
    return frozenset(m for m in found if m in modules() and m != module)


def room(module: str) -> str:
    parts = module.split(".")[1:]
    return ".".join(parts[:2]) if parts[0:1] in (["physics"], ["discovery"]) else (parts[0] if parts else "")


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Every circle that a walk along the arrows meets."""
    found, done = [], set()

    def walk(place: str, way: list[str]) -> None:
        if place in way:
            found.append([*way[way.index(place) :], place])
        elif place not in done:
            for next in sorted(arrows.get(place, ())):
                walk(next, [*way, place])
            done.add(place)

    for place in arrows:
        walk(place, [])
    return found


def literals(path: Path, names: frozenset[str] = NAMES) -> list[tuple[int, str]]:
    """Strings that are one of the names, and names of several words within longer ones; not in docstrings."""
    told = {id(n.value) for n in ast.walk(tree(path)) if isinstance(n, ast.Expr)}
    found = []
    for n in ast.walk(tree(path)):
        if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in told:
            within = {word for word in re.findall(r"\w+", n.value) if "_" in word}
            found += [(n.lineno, name) for name in sorted({n.value, *within} & names)]
    return found


def test_literals_are_seen_within_longer_strings(tmp_path):
    some = tmp_path / "some.py"
    lines = ('"""Of row_noise."""', 'A = "row_noise"', 'B = f"{A} beside row_noise, smear"', 'C = "a smear"')
    some.write_text("\n".join(lines))
    assert literals(some) == [(2, "row_noise"), (3, "row_noise")]


def test_no_mechanism_is_named_outside_its_room():
    assert literals(PACKAGE / "mechanisms" / "readout.py"), "the test sees names where they are"
    for path in modules().values():
        place = path.relative_to(PACKAGE).as_posix()
        if not place.startswith(NAMED):
            assert not literals(path), f"{place}: {literals(path)}"
    for path in (*PACKAGE.rglob("*.jinja"), *PACKAGE.rglob("*.html")):
        assert not {word for word in re.findall(r"\w+", path.read_text()) if "_" in word} & NAMES, path


OTHER_THINGS = frozenset(
    ("black_level", "glow", "hits", "kurtosis", "lattice", "skewness", "step", "telegraph")  # everywhere
    + ("clocking", "comb", "curvature", "dead", "peaks")  # in the kit: kinds, parameters, maps
)
"""Names of signatures that are also words of other things: a field of a recording, a law, a moment."""


def test_no_verb_asks_for_a_signature_by_its_name():
    """Nor does the kit: a signature is told its name, and those of others, by the entry that it is of."""
    names = frozenset(SIGNATURES) - OTHER_THINGS
    assert len(names) > 60 and literals(PACKAGE / "mechanisms" / "unnamed.py", names)
    for path in modules().values():
        place = path.relative_to(PACKAGE).as_posix()
        if not place.startswith(NAMED):
            assert not literals(path, names), f"{place}: {literals(path, names)}"


def defined(module: str) -> list[tuple[str, ast.stmt]]:
    """Names that a module gives to its own functions, classes and constants."""
    out: list[tuple[str, ast.stmt]] = []
    for node in tree(modules()[module]).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        out += [(t.id, node) for t in targets if isinstance(t, ast.Name)]
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            out.append((node.name, node))
    return out


def used(node: ast.AST) -> Counter[str]:
    """Names that are read, imported, or written in a string that is a name, a dotted one or a type."""
    found: Counter[str] = Counter()
    for n in ast.walk(node):
        if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load):
            found[n.id] += 1
        elif isinstance(n, ast.Attribute):
            found[n.attr] += 1
        elif isinstance(n, ast.ImportFrom):
            found.update(alias.name for alias in n.names)
        elif isinstance(n, ast.Constant) and isinstance(n.value, str) and re.fullmatch(r"[\w.|, ]+", n.value):
            found.update(re.findall(r"\w+", n.value))
    return found


def test_every_name_is_used_by_the_package_itself():
    """None is there for its tests alone. A decorated function may be called by what decorates it."""
    everywhere = sum((used(tree(path)) for path in modules().values()), Counter())
    everywhere.update(("as_config", "MECHANISMS"))  # of a configuration file; of a user's script
    dead = [
        f"{module}.{name}"
        for module in modules()
        for name, node in defined(module)
        if not name.startswith("__")
        and not getattr(node, "decorator_list", [])
        and everywhere[name] <= (used(node)[name] if isinstance(node, ast.FunctionDef | ast.ClassDef) else 0)
    ]
    assert not dead


WHOLE = {
    "_Look": "stacked, field, unit, mean, extra, usable = look",
    "Curves": 'getattr(curves, f"{name}_spectrum")',
    "Effect": "getattr(effect, name)",
    "ArrayPatches": 'getattr(self.source, "setting", None)',
}
"""Records of which fields are read without their names: all at once, or by a name that is put together."""
GIVEN = {("Examples", "strong")}
"""Fields that tests and users read: values at which a mechanism is tested."""


def fields_of(path: Path) -> dict[str, set[str]]:
    """The fields of every record of a module: classes of values, named tuples and data classes alike."""
    return {
        node.name: {
            n.target.id for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)
        }
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ClassDef)
    }


def fields_read(paths: list[Path]) -> set[str]:
    """Names that are read off a value, in modules or in templates. By name alone: a field that no one reads
    goes unnoticed where another record has one of its name that is read."""
    found = {
        n.attr
        for path in paths
        for n in ast.walk(tree(path))
        if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Load)
    }
    templates = (path.read_text() for path in PACKAGE.rglob("*.jinja"))
    return found.union(*(re.findall(r"\.(\w+)", text) for text in templates))


def test_every_field_of_a_record_is_read_by_the_package_itself(tmp_path):
    some = tmp_path / "some.py"
    some.write_text(
        "class A(NamedTuple):\n    told: int\n    left: int\n\n\ndef f(a):\n    a.left = a.told\n"
    )
    assert fields_of(some) == {"A": {"told", "left"}}
    assert {"told"} == fields_read([some]) - fields_read([])
    read = fields_read(list(modules().values()))
    unread = {
        (record, name)
        for path in modules().values()
        for record, fields in fields_of(path).items()
        for name in fields - read
    }
    assert {record for record, _ in unread - GIVEN} == set(WHOLE), "of others nothing is unread"
    assert unread >= GIVEN
    text = "\n".join(path.read_text() for path in modules().values())
    assert all(how in text for how in WHOLE.values())


def test_no_module_imports_itself_in_a_circle():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}}) == [["a", "b", "c", "a"]]
    assert not circles({module: set(imports(module)) for module in modules()})
    assert not circles({module: set(imports(module, types=True)) for module in modules()}), "of types"


def test_modules_are_imported_by_their_names_but_where_it_is_known():
    """What strings name is no circle that a walk over imports sees."""
    assert {"cannoise_jax.mechanisms", "cannoise_jax.sampling"} <= imports("cannoise_jax")
    found = {m for m, path in modules().items() if {"import_module", "__import__"} & set(used(tree(path)))}
    assert found == set(BY_STRINGS)
    asked = {m for m, path in modules().items() if "on_first_use" in used(tree(path))}
    assert asked == set(ON_FIRST_USE)


def test_no_two_rooms_import_each_other():
    arrows: dict[str, set[str]] = {}
    for module in modules():
        arrows.setdefault(room(module), set()).update(room(m) for m in imports(module))
    for one, others in arrows.items():
        others.discard(one)
    assert not circles(arrows)


@pytest.mark.parametrize("floor", range(len(FLOORS) - 1), ids=lambda n: FLOORS[n][0])
def test_nothing_points_up(floor):
    above = {name for rooms in FLOORS[floor + 1 :] for name in rooms}
    for module in modules():
        if room(module) in FLOORS[floor]:
            wrong = {m for m in imports(module) if room(m) in above}
            assert not wrong, f"{module} imports {sorted(wrong)}"


def test_every_room_has_a_floor():
    assert sorted({room(m) for m in modules()}) == sorted(name for rooms in FLOORS for name in rooms)


def test_the_ground_floor_imports_nothing():
    assert not imports("cannoise_jax.vocabulary") and not imports("cannoise_jax.exports")


def by_place(path: Path) -> dict[str, int]:
    """How many arguments functions of a module take by their place; of methods those beside the record."""
    return {
        f"{path.relative_to(PACKAGE)}:{f.lineno}: {f.name}": sum(
            a.arg not in ("self", "cls") for a in (*f.args.posonlyargs, *f.args.args)
        )
        for f in ast.walk(tree(path))
        if isinstance(f, ast.FunctionDef)
    }


def test_what_many_arguments_mean_is_said_where_they_are_given():
    """Six by their place at most: a seventh is given by its name, or several of them are a record."""
    rooms = ("physics", "signatures", "mechanisms", "discovery")
    counts = {
        k: n for room in rooms for path in (PACKAGE / room).rglob("*.py") for k, n in by_place(path).items()
    }
    assert max(counts.values()) == 6, {k: n for k, n in counts.items() if n > 6}


def without_words(path: Path) -> list[str]:
    """Numbers that a module names without a line below them, or a remark, that says what they are."""
    body, lines = tree(path).body, path.read_text().splitlines()

    def plain(node: ast.stmt) -> bool:
        try:
            values = ast.literal_eval(node.value) if isinstance(node, ast.Assign | ast.AnnAssign) else None
        except ValueError:
            return False
        values = values if isinstance(values, tuple) else (values,)
        return all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)

    def told(number: int) -> bool:
        after = next((n for n in body[number:] if not isinstance(n, ast.Assign | ast.AnnAssign)), None)
        said = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        at = body[number].lineno
        return said or "#" in lines[at - 1] or lines[at - 2].lstrip().startswith("#")

    return [lines[n.lineno - 1] for k, n in enumerate(body) if plain(n) and not told(k)]


def test_numbers_that_have_a_name_say_what_they_are(tmp_path):
    some = tmp_path / "some.py"
    some.write_text('A = 1\nB = 2.0\n"""Two."""\nC = "a"\nD, E = 1, 2\n\n\ndef f():\n    pass\n')
    assert without_words(some) == ["D, E = 1, 2"]
    rooms = ("physics", "signatures", "mechanisms", "discovery")
    found = {path: without_words(path) for room in rooms for path in (PACKAGE / room).rglob("*.py")}
    assert not {path: numbers for path, numbers in found.items() if numbers}


def late_imports(module: str) -> set[tuple[str, str]]:
    """What functions of a module import of the package."""
    inner = (
        n for f in ast.walk(tree(modules()[module])) if isinstance(f, ast.FunctionDef) for n in ast.walk(f)
    )
    found = {n.module for n in inner if isinstance(n, ast.ImportFrom) and n.module}
    return {(module, target) for target in found if target.startswith("cannoise_jax")}


def test_imports_wait_for_their_use_only_where_a_command_starts():
    """Commands say at once what is wrong with their flags, and benches load one of two libraries. Elsewhere
    no function imports of the package, so that none is needed to avoid a circle."""
    starts = ("cannoise_jax.commands.", "cannoise_jax.bench.")
    assert not {arrow for m in modules() if not m.startswith(starts) for arrow in late_imports(m)}


def test_no_name_is_undefined():
    """The linter's own rule takes the shape strings of jaxtyping for names: dimensions are single letters."""
    ruff = [
        sys.executable,
        "-m",
        "ruff",
        "check",
        "--isolated",
        "--select",
        "F821",
        "--output-format",
        "json",
    ]
    said = subprocess.run(
        [*ruff, str(PACKAGE), str(PACKAGE.parent / "tests")], capture_output=True, text=True
    )
    found = [f"{f['filename']}:{f['location']['row']}: {f['message']}" for f in json.loads(said.stdout)]
    assert [line for line in found if not re.search(r"`\w`$", line)] == []
