"""Temperature and biases that make probabilities of logits: chosen so that what happens is as likely as is said.

Temperature scaling divides all logits by one number (Guo et al., ICML 2017). Training queries are not spread as space
is, so frequencies of classes differ as well: then one bias for each class is added, which makes up for the average of
it. Both are found by the likelihood of the true labels, whose maximum is unique. Labels are not touched.

Notation: n points, c classes.
"""

import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import minimize
from scipy.special import log_softmax, softmax

from mereo.evaluation.reliability import Reliability
from mereo.models.calibration import Scaling
from mereo.models.scaled_logits import scaled_array

GOOD_ENOUGH = 0.02
"""Expected calibration error up to which the temperature does alone: two thirds of what is wanted of unseen views."""


def ece_of(
    logits: Float[np.ndarray, "n c"],
    truth: UInt8[np.ndarray, " n"],
    scaling: Scaling = Scaling(),  # noqa: B008 (frozen)
) -> float:
    """Expected calibration error of the scaled probability of the most likely class by the logits as they are."""
    labels, rows = logits.argmax(axis=1), np.arange(len(logits))
    counted = Reliability()
    counted.add(softmax(scaled_array(scaling, logits).astype(np.float64), axis=1)[rows, labels], labels == truth)
    return counted.ece


def fit_scaling(logits: Float[np.ndarray, "n c"], truth: UInt8[np.ndarray, " n"]) -> Scaling:
    """The simplest scaling that is good enough: a temperature, or also a bias for each class."""
    alone = _most_likely(logits, truth, biased=False)
    return alone if ece_of(logits, truth, alone) <= GOOD_ENOUGH else _most_likely(logits, truth, biased=True)


def _most_likely(logits: Float[np.ndarray, "n c"], truth: UInt8[np.ndarray, " n"], biased: bool) -> Scaling:
    """Scaling under which the true labels are most likely; its logarithm is concave in 1 / temperature and biases."""
    values = logits.astype(np.float64)
    count, classes = values.shape
    hot = np.eye(classes)[truth]

    def loss(parameters: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        scale = np.exp(parameters[0])
        biases = np.concatenate([[0.0], parameters[1:]]) if biased else np.zeros(classes)
        likelihood = log_softmax(values * scale + biases, axis=1)
        residual = (np.exp(likelihood) - hot) / count
        gradient = [(residual * values).sum() * scale, *(residual.sum(axis=0)[1:] if biased else ())]
        return -float((likelihood * hot).sum()) / count, np.array(gradient)

    found = minimize(loss, np.zeros(classes if biased else 1), jac=True, method="L-BFGS-B").x
    return Scaling(float(np.exp(-found[0])), (0.0, *map(float, found[1:])) if biased else None)
