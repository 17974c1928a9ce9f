"""Ways of changing a model between two runs, or during a run, and what the cache makes of each.

``python -m tests.faults.model_changes`` prints the table. A change is

* noticed: the fingerprint is another one, so that no stored simulation is used, or the model is refused;
* verified: the fingerprint is the same, and a stored simulation differs from a new one (`StaleCache`);
* documented: neither; the documentation says that only the user can know of it.

The modules of the user are written into a folder, imported, edited, and imported afresh, as by a new program.
"""

import builtins
import importlib
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import (
    Channel,
    ExecutableModel,
    FELikelihood,
    FunctionModel,
    Measurements,
    SimulationCache,
    StaleCache,
)
from fe_likelihoods.models.function import _changes_itself, _observed
from fe_likelihoods.simulation import changed_model, source_digest, used_modules
from fe_likelihoods.simulation.faults import ChangedModel

CHANNELS = (Channel("a", "displacement", "m"),)
NAMES = ("offset", "slope")
N_STEPS = 20
DATA = Measurements(CHANNELS, 0.1, np.sin(np.arange(1.0 * N_STEPS))[None])
THETAS = np.random.default_rng(7).uniform(0.1, 0.8, size=(6, 2))
LINE = "import numpy as np\n\ndef line(theta):\n    return theta[0] + theta[1] * np.arange(20.0)[None]\n\n"
NOTICED, VERIFIED, DOCUMENTED = "noticed", "verified", "documented"


class Between(NamedTuple):
    """A change of files, variables or arguments between two runs.

    Attributes
    ----------
    name : str
    expected : str
    files : dict of str to str
        Names and contents. ``user.py`` defines the function `f`, or `model(folder)` or `noise()`.
    edit : tuple (name, old, new)
        Replacement in one of the files, or of a variable of the environment if the name begins with ``$``.
    options : dict
        Of `FunctionModel`; a callable value is called with the folder.
    cache : dict
        Settings of the cache in the second run.
    """

    name: str
    expected: str
    files: dict[str, str]
    edit: tuple[str, str, str]
    options: dict[str, Any] = {}
    cache: dict[str, Any] = {}


class During(NamedTuple):
    """A change during a run, by a function of the folder, the imported module and the likelihood."""

    name: str
    files: dict[str, str]
    change: Callable[[Path, Any, FELikelihood], Any]
    options: dict[str, Any] = {}


def user(body: str, **others: str) -> dict[str, str]:
    """Files of a user: his script, and further modules."""
    names = {name: name.replace("__", "/").replace("/init", "/__init__") + ".py" for name in others}
    return {"user.py": LINE + body} | {names[name]: text for name, text in others.items()}


HELPER = "E = 2.0\ndef g(x):\n    return x * 3.0\n"
IN_HELPER = ("helper.py", "3.0", "4.0")


def in_user(old: str, new: str) -> tuple[str, str, str]:
    return "user.py", old, new


def number(name: str, body: str, expected: str = NOTICED) -> Between:
    """A change of a number in the user's script."""
    return Between(name, expected, user(body), in_user("2.5", "2.6"))


def helper(name: str, body: str, expected: str = NOTICED) -> Between:
    """A change in another file of the user."""
    return Between(name, expected, user(body, helper=HELPER), IN_HELPER)


CODE = [
    number("a constant", "def f(theta): return 2.5 * line(theta)"),
    Between("an operator", NOTICED, user("def f(theta): return 2.5 * line(theta)"), in_user("2.5 *", "2.5 +")),
    number("a default argument", "def f(theta, k=2.5): return k * line(theta)"),
    number("a keyword default", "def f(t, *, k=2.5): return k * line(t)"),
    number("a global number", "E = 2.5\ndef f(theta): return E * line(theta)"),
    number("a global array", "E = np.array([2.5])\ndef f(t): return E * line(t)"),
    number("a global dict", "E = {'E': 2.5}\ndef f(t): return E['E'] * line(t)"),
    number("a function of the same file", "def g(x): return 2.5 * x\ndef f(theta): return g(line(theta))"),
    number("a nested function", "def f(t):\n    def g(x): return 2.5 * x\n    return g(line(t))"),
    number("a lambda", "g = lambda x: 2.5 * x\ndef f(theta): return g(line(theta))"),
    number("a value in a closure", "def make(k):\n    return lambda theta: k * line(theta)\nf = make(2.5)"),
    number(
        "an argument of a partial",
        "import functools\ndef g(k, theta): return k * line(theta)\nf = functools.partial(g, 2.5)",
    ),
    number("a method", "class A:\n    def r(self, t): return 2.5 * line(t)\nf = A().r"),
    number(
        "a method of a base class", "class A:\n    def r(self, t): return 2.5 * line(t)\nclass B(A): pass\nf = B().r"
    ),
    number("a class attribute", "class A:\n    k = 2.5\n    def r(self, t): return self.k * line(t)\nf = A().r"),
    number(
        "a property",
        "class A:\n    k = property(lambda self: 2.5)\n    def r(self, t): return self.k * line(t)\nf = A().r",
    ),
    number(
        "a field of a dataclass",
        "from dataclasses import dataclass\n@dataclass\nclass A:\n    k: float\n"
        "    def __call__(self, t): return self.k * line(t)\nf = A(2.5)",
    ),
    number("a value of an enum", "import enum\nclass E(enum.Enum):\n    A = 2.5\ndef f(t): return E.A.value * line(t)"),
    number(
        "a default of a named tuple",
        "from typing import NamedTuple\nclass A(NamedTuple):\n    k: float = 2.5\ndef f(t): return A().k * line(t)",
    ),
    helper("a function of another file", "from helper import g\ndef f(t): return g(line(t))"),
    helper("a function of an imported module", "import helper\ndef f(t): return helper.g(line(t))"),
    helper("import *", "from helper import *\ndef f(t): return g(line(t))"),
    Between(
        "a decorator in another file",
        NOTICED,
        user(
            "from helper import twice\n@twice\ndef f(t): return line(t)",
            helper="def twice(h):\n    return lambda t: 3.0 * h(t)\n",
        ),
        IN_HELPER,
    ),
    number(
        "a class in a table of classes",
        "class A:\n    k = 2.5\nTABLE = {'a': A}\ndef f(t): return TABLE['a'].k * line(t)",
    ),
    number(
        "a static method", "class A:\n    @staticmethod\n    def g(x): return 2.5 * x\ndef f(t): return A.g(line(t))"
    ),
    Between(
        "a table that __post_init__ loads from a file",
        NOTICED,
        user(
            "from dataclasses import dataclass\nfrom pathlib import Path\n@dataclass\nclass A:\n    name: str\n"
            "    def __post_init__(self):\n        self.k = np.loadtxt(Path(__file__).parent / self.name)\n"
            "    def __call__(self, t): return self.k * line(t)\nf = A('table.txt')"
        )
        | {"table.txt": "2.5"},
        ("table.txt", "2.5", "2.6"),
    ),
    number(
        "an attribute of a dataclass that is no field",
        "from dataclasses import dataclass\n@dataclass\nclass A:\n    n: int\n"
        "    def __call__(self, t): return self.k * line(t)\nf = A(1)\nf.k = 2.5",
    ),
    Between(
        "from pkg import part in the function",
        NOTICED,
        user("def f(t):\n    from pkg import part\n    return part.g(line(t))", pkg__init="", pkg__part=HELPER),
        ("pkg/part.py", "3.0", "4.0"),
    ),
    Between(
        "import pkg.part in the function",
        NOTICED,
        user("def f(t):\n    import pkg.part\n    return pkg.part.g(line(t))", pkg__init="", pkg__part=HELPER),
        ("pkg/part.py", "3.0", "4.0"),
    ),
    Between(
        "from pkg.part import g in the function",
        NOTICED,
        user("def f(t):\n    from pkg.part import g\n    return g(line(t))", pkg__init="", pkg__part=HELPER),
        ("pkg/part.py", "3.0", "4.0"),
    ),
    helper("import helper as h in the function", "def f(t):\n    import helper as h\n    return h.g(line(t))"),
    Between(
        "a relative import in the function",
        NOTICED,
        user(
            "from pkg.main import f",
            pkg__init="",
            pkg__main=LINE + "def f(t):\n    from . import part\n    return part.g(line(t))",
            pkg__part=HELPER,
        ),
        ("pkg/part.py", "3.0", "4.0"),
    ),
    helper("a module as default argument", "import helper\ndef f(t, h=helper): return h.g(line(t))"),
    helper(
        "a module in a closure", "def make():\n    import helper\n    return lambda t: helper.g(line(t))\nf = make()"
    ),
    helper(
        "a module as attribute",
        "import helper\nclass A:\n    def __init__(self): self.h = helper\n"
        "    def r(self, t): return self.h.g(line(t))\nf = A().r",
    ),
    helper("a module in a dict", "import helper\nD = {'h': helper}\ndef f(t): return D['h'].g(line(t))"),
    helper("a module in a list", "import helper\nD = [helper]\ndef f(t): return D[0].g(line(t))"),
    helper(
        "a module in a partial",
        "import functools, helper\ndef g(h, t): return h.g(line(t))\nf = functools.partial(g, helper)",
    ),
    Between(
        "a module of a module in a dict",
        NOTICED,
        user(
            "import outer\nD = {'o': outer}\ndef f(t): return D['o'].helper.g(line(t))",
            outer="import helper\n",
            helper=HELPER,
        ),
        IN_HELPER,
    ),
    Between(
        "a file of the user named trace.py",
        NOTICED,
        user("import trace\ndef f(t): return trace.g(line(t))", trace=HELPER),
        ("trace.py", "3.0", "4.0"),
    ),
    Between(
        "a function of a file named wave.py",
        NOTICED,
        user("from wave import g\ndef f(t): return g(line(t))", wave=HELPER),
        ("wave.py", "3.0", "4.0"),
    ),
    number("class MPa(float)", "class MPa(float): pass\nE = MPa(2.5)\ndef f(t): return E * line(t)"),
    number("class Name(str)", "class Name(str): pass\nE = Name('2.5')\ndef f(t): return float(E) * line(t)"),
    number("an item of a subclass of list", "class L(list): pass\nE = L([2.5])\ndef f(t): return E[0] * line(t)"),
    number(
        "a method of a subclass of dict",
        "class D(dict):\n    def __missing__(self, key): return 2.5\nE = D()\ndef f(t): return E['E'] * line(t)",
    ),
    number(
        "an attribute of a subclass of ndarray",
        "class A(np.ndarray): pass\nE = np.ones(1).view(A)\nE.k = 2.5\ndef f(t): return E.k * line(t)",
    ),
    number(
        "the factory of a defaultdict",
        "from collections import defaultdict\nE = defaultdict(lambda: 2.5)\n"
        "def f(t): return E.default_factory() * line(t)",
    ),
    number("an attribute of a function", "def f(t): return f.k * line(t)\nf.k = 2.5"),
    number(
        "a slot",
        "class A:\n    __slots__ = ('k',)\n    def __init__(self): self.k = 2.5\n"
        "    def r(self, t): return self.k * line(t)\nf = A().r",
    ),
    number(
        "a function with a cache of results",
        "import functools\n@functools.cache\ndef g(x): return 2.5 * x\ndef f(t): return g(t[0]) + line(t)",
    ),
    number(
        "a cached property",
        "import functools\nclass A:\n    k = functools.cached_property(lambda self: 2.5)\n"
        "    k.__set_name__(None, 'k')\n    def r(self, t): return self.k * line(t)\nf = A().r",
    ),
    number(
        "an attribute of a function with a cache of results",
        "import functools\n@functools.cache\ndef g(x): return g.k * x\ng.k = 2.5\ndef f(t): return g(t[0]) + line(t)",
    ),
    number(
        "an attribute of a partial",
        "import functools\ndef g(t): return f.k * line(t)\nf = functools.partial(g)\nf.k = 2.5",
    ),
    number(
        "an attribute of a wrapped function",
        "import functools\ndef g(t): return line(t)\ng.k = 2.5\n@functools.wraps(g)\n"
        "def f(t): return f.__wrapped__.k * line(t)",
    ),
    number(
        "a method of a metaclass",
        "class M(type):\n    def k(cls): return 2.5\nclass A(metaclass=M): pass\ndef f(t): return A.k() * line(t)",
    ),
    number("a name in builtins", "import builtins\nbuiltins.WAY = 2.5\ndef f(t): return WAY * line(t)"),
    Between(
        "another function in builtins",
        NOTICED,
        user("import builtins, math\nbuiltins.way = math.floor\ndef f(t): return line(t) + way(2.5)"),
        in_user("floor", "ceil"),
    ),
    number(
        "a value that replaces a cached property",
        "import functools\nclass A:\n    @functools.cached_property\n    def k(self): return 1.0\n"
        "    def r(self, t): return self.k * line(t)\na = A()\na.k = 2.5\nf = a.r",
        expected=VERIFIED,
    ),
    number(
        "the statistic of a noise of the user",
        "from fe_likelihoods import GaussianNoise\nclass Noise(GaussianNoise):\n    @staticmethod\n"
        "    def statistic(r): return 2.5 * (r**2).sum(axis=1)\ndef f(t): return line(t)\n"
        "def noise(channels): return Noise(channels)",
    ),
    number(
        "a method of a subclass of a model of the library",
        "from fe_likelihoods import FunctionModel, Channel\nclass Own(FunctionModel):\n"
        "    def _respond(self, t): return 2.5 * line(t)\n"
        "def model(folder): return Own(line, ('offset', 'slope'), (Channel('a', 'displacement', 'm'),), 0.1, 20)",
    ),
    Between(
        "a number that is read from the environment at import",
        NOTICED,
        user("import os\nE = float(os.environ['WAY'])\ndef f(t): return E * line(t)"),
        ("$WAY", "2.5", "2.6"),
    ),
    Between(
        "the text version=",
        NOTICED,
        user("def f(t): return 2.5 * line(t)"),
        in_user("2.5", "2.6"),
        {"version": lambda folder: (folder / "user.py").read_text()},
    ),
    number(
        "a class of the user with a fixed fingerprint",
        "from fe_likelihoods import Channel\nclass Own:\n    parameter_names = ('offset', 'slope')\n"
        "    channels = (Channel('a', 'displacement', 'm'),)\n"
        "    dt, n_steps, fingerprint = 0.1, 20, 'own'\n"
        "    def simulate(self, t): return 2.5 * line(t)\ndef model(folder): return Own()",
        expected=VERIFIED,
    ),
    Between(
        "a version= that was not changed",
        VERIFIED,
        user("def f(t): return 2.5 * line(t)"),
        in_user("2.5", "2.6"),
        {"version": "1"},
    ),
    helper(
        "a module imported by a computed name",
        "import importlib\ndef f(t): return getattr(importlib.import_module('hel' + str('per')), 'g')(line(t))",
        expected=VERIFIED,
    ),
    helper(
        "a computed name of an attribute",
        "import helper\nNAME = ''.join(['g'])\ndef f(t): return getattr(helper, NAME)(line(t))",
        expected=VERIFIED,
    ),
    number("globals() with a name", "E = 2.5\ndef f(t): return globals()['E'] * line(t)", expected=VERIFIED),
    number("code in a text", "E = 2.5\ndef f(t): return eval('E') * line(t)", expected=VERIFIED),
]

READS = "from pathlib import Path\ndef f(t): return np.loadtxt(Path(__file__).parent / 'table.txt') * line(t)"
TABLE = {"table.txt": "2.5"}
IN_TABLE = ("table.txt", "2.5", "2.6")
RARE = (
    "from pathlib import Path\ndef f(t):\n    k = float((Path(__file__).parent / 'table.txt').read_text())\n"
    "    return line(t) * (k if t[0] > 0.75 else 1.0)"
)
PROGRAM = (
    "from fe_likelihoods import Channel, ExecutableModel\ndef model(folder):\n    return ExecutableModel({command}, "
    "{{'in.txt': '$offset $slope'}}, 'out.txt', ('offset', 'slope'), (Channel('a', 'displacement', 'm'),), 0.1, 20, "
    "time_limit=30.0{options})"
)
SCRIPT = "awk '{{ for (k = 0; k < 20; k++) print {0} * $1 + $2 * k }}' in.txt > out.txt\n"


def program(command: str, script: str, options: str = "", **others: str) -> dict[str, str]:
    """Files of a user who runs a shell script."""
    return user(PROGRAM.format(command=command, options=options)) | {"run.sh": SCRIPT.format(script)} | others


OUTSIDE = [
    Between(
        "a data file that is read at import",
        NOTICED,
        user(READS.replace("def f(t): return", "K =").replace(" * line(t)", "") + "\ndef f(t): return K * line(t)")
        | TABLE,
        IN_TABLE,
    ),
    Between("a data file that is read while running", VERIFIED, user(READS) | TABLE, IN_TABLE),
    Between(
        "the same with depends_on",
        NOTICED,
        user(READS) | TABLE,
        IN_TABLE,
        {"depends_on": lambda folder: [folder / "table.txt"]},
    ),
    Between(
        "a file in a folder of depends_on",
        NOTICED,
        user(READS) | TABLE,
        IN_TABLE,
        {"depends_on": lambda folder: [folder]},
    ),
    Between(
        "a variable of the environment that is read while running",
        VERIFIED,
        user("import os\ndef f(t): return float(os.environ['WAY']) * line(t)"),
        ("$WAY", "2.5", "2.6"),
    ),
    Between(
        "the same with depends_on",
        NOTICED,
        user("import os\ndef f(t): return float(os.environ['WAY']) * line(t)"),
        ("$WAY", "2.5", "2.6"),
        {"depends_on": lambda folder: [os.environ["WAY"]]},
    ),
    Between(
        "code in a file that is executed",
        VERIFIED,
        user(
            "from pathlib import Path\ndef f(t):\n    code = (Path(__file__).parent / 'table.txt').read_text()\n"
            "    return eval(code) * line(t)"
        )
        | TABLE,
        IN_TABLE,
    ),
    Between(
        "a script of a program, by its path",
        NOTICED,
        program("['sh', str(folder / 'run.sh')]", "2.5"),
        ("run.sh", "2.5", "2.6"),
    ),
    Between(
        "a script of a program, --script=/path",
        NOTICED,
        program(
            "['env', '--chdir=.', 'sh', '-c', 'sh \"${1#*=}\"', 'x', f'--script={folder}/run.sh']".replace(
                "${1", "$${1"
            ),
            "2.5",
        ),
        ("run.sh", "2.5", "2.6"),
    ),
    Between(
        "a file that a script reads",
        VERIFIED,
        program("['sh', str(folder / 'run.sh')]", "'$(cat $(dirname $0)/k.txt)'", **{"k.txt": "2.5"}),
        ("k.txt", "2.5", "2.6"),
    ),
    Between(
        "the same with depends_on",
        NOTICED,
        program(
            "['sh', str(folder / 'run.sh')]",
            "'$(cat $(dirname $0)/k.txt)'",
            ", depends_on=[folder / 'k.txt']",
            **{"k.txt": "2.5"},
        ),
        ("k.txt", "2.5", "2.6"),
    ),
    Between(
        "a variable of the environment of a program",
        VERIFIED,
        program("['sh', str(folder / 'run.sh')]", "'$WAY'"),
        ("$WAY", "2.5", "2.6"),
    ),
    Between(
        "a file that matters only where nothing is verified", DOCUMENTED, user(RARE) | {"table.txt": "2.5"}, IN_TABLE
    ),
    Between(
        "a change of the response below the tolerance",
        DOCUMENTED,
        user(READS) | TABLE,
        ("table.txt", "2.5", "2.5000000001"),
    ),
    Between("a data file, with verify=False", DOCUMENTED, user(READS) | TABLE, IN_TABLE, {}, {"verify": False}),
]


def assign(place: str, value: Any) -> Callable:
    """Change of a variable of the user's module, such as ``E`` or ``helper.E``."""

    def change(folder: Path, module: Any, *_: Any) -> None:
        *owners, name = place.split(".")
        for owner in owners:
            module = getattr(module, owner)
        setattr(module, name, value)

    return change


def item(place: str, key: Any, value: Any) -> Callable:
    """Change of an item of an object of the user's module."""
    return lambda folder, module, *_: getattr(module, place).__setitem__(key, value)


def rewrite(name: str, text: str) -> Callable:
    """Change of a file."""
    return lambda folder, *_: (folder / name).write_text(text)


def reload_user(folder: Path, module: Any, *_: Any) -> None:
    (folder / "helper.py").write_text(HELPER.replace("3.0", "40.0"))
    importlib.reload(sys.modules["helper"])


CALLS_HELPER = user("import helper\ndef f(t): return helper.g(line(t)) * helper.E", helper=HELPER)

SUBCLASS = (
    "from fe_likelihoods import FunctionModel, Channel\nclass Own(FunctionModel):\n    c = 1.0\n"
    "    def _respond(self, t): return self.c * self.k * line(t)\ndef model(folder):\n"
    "    own = Own(line, ('offset', 'slope'), (Channel('a', 'displacement', 'm'),), 0.1, 20)\n    own.k = 2.5\n"
    "    return own"
)
META = "class M(type):\n    k = 2.5\nclass A(metaclass=M): pass\ndef f(t): return A.k * line(t)"
BUILTIN = "import builtins\nbuiltins.WAY = 2.5\ndef f(t): return WAY * line(t)"

DURING = [
    During("a global number", user("E = 2.5\ndef f(t): return E * line(t)"), assign("E", 2.6)),
    During("a global dict, in place", user("E = {'E': 2.5}\ndef f(t): return E['E'] * line(t)"), item("E", "E", 2.6)),
    During("a global array, in place", user("E = np.array([2.5])\ndef f(t): return E * line(t)"), item("E", 0, 2.6)),
    During(
        "a list in a closure, in place",
        user("E = [2.5]\ndef make(k):\n    return lambda t: k[0] * line(t)\nf = make(E)"),
        item("E", 0, 2.6),
    ),
    During(
        "an attribute of the object",
        user("class A:\n    k = 2.5\n    def r(self, t): return self.k * line(t)\na = A()\nf = a.r"),
        assign("a.k", 2.6),
    ),
    During(
        "a class attribute",
        user("class A:\n    k = 2.5\n    def r(self, t): return self.k * line(t)\nf = A().r"),
        assign("A.k", 2.6),
    ),
    During(
        "an attribute of a subclass of a model of the library",
        user(SUBCLASS),
        lambda folder, module, likelihood: setattr(likelihood.model, "k", 2.6),
    ),
    During("a class attribute of such a subclass", user(SUBCLASS), assign("Own.c", 1.1)),
    During("a metaclass attribute", user(META), assign("M.k", 2.6)),
    During("a name in builtins", user(BUILTIN), assign("builtins.WAY", 2.6)),
    During("a variable of another module", CALLS_HELPER, assign("helper.E", 2.6)),
    During("importlib.reload", CALLS_HELPER, reload_user),
    During("an attribute of a function", user("def f(t): return f.k * line(t)\nf.k = 2.5"), assign("f.k", 2.6)),
    During(
        "a data file in depends_on",
        user(READS) | TABLE,
        rewrite("table.txt", "2.6"),
        {"depends_on": lambda folder: [folder / "table.txt"]},
    ),
    During(
        "the script of a program",
        program("['sh', str(folder / 'run.sh')]", "2.5"),
        rewrite("run.sh", SCRIPT.format("2.6")),
    ),
    During(
        "another model",
        user("def f(t): return 2.5 * line(t)"),
        lambda folder, module, likelihood: setattr(
            likelihood, "model", FunctionModel(lambda t: 2.0 * module.line(t), NAMES, CHANNELS, 0.1, N_STEPS)
        ),
    ),
]


@contextmanager
def workshop(files: dict[str, str]):
    """A folder with the files of a user, from which modules are imported."""
    path, modules = list(sys.path), dict(sys.modules)
    share, writes = changed_model._SHARE_OF_TIME, sys.dont_write_bytecode
    changed_model._SHARE_OF_TIME, sys.dont_write_bytecode = np.inf, True  # every batch is checked
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)
        sys.path.insert(0, str(folder))
        try:
            yield folder
        finally:
            sys.path[:] = path
            forget_modules(folder)
            for name, module in modules.items():
                sys.modules.setdefault(name, module)
            changed_model._SHARE_OF_TIME, sys.dont_write_bytecode = share, writes
            os.environ.pop("WAY", None)
            for name in ("WAY", "way"):
                vars(builtins).pop(name, None)


def forget_modules(folder: Path) -> None:
    """As in a new process: modules of the user, and of the same name, are not imported."""
    own = {file.relative_to(folder).with_suffix("").as_posix().replace("/", ".") for file in folder.rglob("*.py")}
    own |= {name.removesuffix(".__init__") for name in own}
    for name in own & set(sys.modules):
        del sys.modules[name]
    importlib.invalidate_caches()
    for cached in (used_modules.is_own, used_modules.package_version, source_digest.is_standard):
        cached.cache_clear()
    _observed.clear()
    _changes_itself.clear()


def likelihood_of(folder: Path, options: dict[str, Any], cache: SimulationCache | None) -> FELikelihood:
    """Likelihood of the user's model, imported afresh."""
    forget_modules(folder)
    module = importlib.import_module("user")
    if hasattr(module, "model"):
        model = module.model(folder)
    else:
        options = {name: value(folder) if callable(value) else value for name, value in options.items()}
        model = FunctionModel(module.f, NAMES, CHANNELS, 0.1, N_STEPS, **options)
    noise = module.noise(CHANNELS) if hasattr(module, "noise") else None
    return FELikelihood(model, DATA, noise, cache=cache)


def between(way: Between) -> str:
    """What the cache makes of a change between two runs."""
    with workshop(way.files) as folder, tempfile.TemporaryDirectory() as other:
        path, (name, old, new) = Path(other) / "cache.sqlite", way.edit
        os.environ["WAY"] = old
        first = likelihood_of(folder, way.options, SimulationCache(path))
        thetas = THETAS[:2] if isinstance(first.model, ExecutableModel) else THETAS
        values = first.misfit(thetas)
        if not np.isfinite(values).all():
            raise RuntimeError(f"{way.name}: {first.failures}")
        if name.startswith("$"):
            os.environ["WAY"] = new
        else:
            text = (folder / name).read_text()
            if old not in text:
                raise RuntimeError(f"{way.name}: {name} does not contain {old}")
            (folder / name).write_text(text.replace(old, new))
        truth = likelihood_of(folder, way.options, None).misfit(thetas)
        if np.array_equal(truth, values) and way.expected != DOCUMENTED:
            raise RuntimeError(f"{way.name}: the change has no effect")
        second = likelihood_of(folder, way.options, SimulationCache(path, **way.cache))
        try:
            result = second.misfit(thetas)
        except StaleCache:
            return VERIFIED
        if second.disk_hits:
            return DOCUMENTED
        if not np.array_equal(result, truth):
            raise RuntimeError(f"{way.name}: not the values of the model")
        return NOTICED


def during(way: During) -> str:
    """What the cache makes of a change during a run: no simulation after it may be stored."""
    with workshop(way.files) as folder, tempfile.TemporaryDirectory() as other:
        likelihood = likelihood_of(folder, way.options, SimulationCache(Path(other) / "cache.sqlite"))
        likelihood.misfit(THETAS[:2])
        way.change(folder, sys.modules["user"], likelihood)
        try:
            likelihood.misfit(THETAS[2:4])
        except ChangedModel:
            stored = likelihood.cache.look_up(likelihood._key, THETAS, 1, N_STEPS).known
            return NOTICED if stored.tolist() == [True, True, False, False, False, False] else "stored"
        return "not noticed"


def main() -> None:
    counts: Counter[str] = Counter()
    parts = [("Between two runs: code", between, CODE), ("Between two runs: outside the code", between, OUTSIDE)]
    for title, run, ways in [*parts, ("During a run", during, DURING)]:
        print(title)
        for way in ways:
            try:
                outcome = run(way)
            except Exception as error:  # the other ways are shown as well
                outcome = f"{type(error).__name__}: {error}"
            counts[outcome] += 1
            expected = getattr(way, "expected", NOTICED)
            print(f"  {way.name:65s}{outcome}{'' if outcome == expected else f'   EXPECTED {expected}'}")
    print(f"{counts.total()} ways: " + ", ".join(f"{count} {outcome}" for outcome, count in counts.most_common()))


if __name__ == "__main__":
    main()
