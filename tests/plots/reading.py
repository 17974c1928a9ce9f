"""What the tests read from a figure."""

import numpy as np


def texts(axes) -> list[str]:
    """Texts of the legend."""
    return [text.get_text() for text in axes.get_legend().get_texts()]


def shows(axes, lines) -> bool:
    """Whether all points of the lines are inside of the limits of the axes."""
    (left, right), (bottom, top) = sorted(axes.get_xlim()), sorted(axes.get_ylim())
    x = np.concatenate([np.ravel(line.get_xdata()) for line in lines if line.get_transform() == axes.transData])
    y = np.concatenate([np.ravel(line.get_ydata()) for line in lines if line.get_transform() == axes.transData])
    return bool(np.all((left <= x) & (x <= right)) and np.all((bottom <= y) & (y <= top)))
