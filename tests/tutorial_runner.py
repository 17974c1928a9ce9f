"""Run a tutorial as a script, and pickle every figure that it saves beside the picture.

    python tests/tutorial_runner.py tutorials/01_linear_oscillator.py --out FOLDER

``FOLDER/name.png`` is then accompanied by ``FOLDER/name.pickle``, so that a test can read axes, labels, limits and
lines of the figure. The documentation shows the figures that are open at the end of a cell, so a tutorial may not close
the figures that it saves: the run fails if it does.
"""

import pickle
import runpy
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.figure import Figure


def main() -> None:
    """Run the script named on the command line with the arguments after it."""
    script = Path(sys.argv[1]).resolve()
    sys.argv = [str(script), *sys.argv[2:]]
    sys.path[0] = str(script.parent)  # as `python script` does
    saved, save = [], Figure.savefig

    def save_and_pickle(figure: Figure, path: Path, **settings) -> None:
        save(figure, path, **settings)
        Path(path).with_suffix(".pickle").write_bytes(pickle.dumps(figure))
        saved.append((figure, path))

    Figure.savefig = save_and_pickle
    runpy.run_path(str(script), run_name="__main__")
    still_open = [pyplot.figure(number) for number in pyplot.get_fignums()]
    closed = [str(path) for figure, path in saved if figure not in still_open]
    if closed:
        sys.exit(f"figures that the tutorial closed, so that the documentation cannot show them: {closed}")


if __name__ == "__main__":
    main()
