"""Terms of the field in the text of a page, each explained where a reader points at it."""

from __future__ import annotations

import re

from markupsafe import Markup, escape

from ..escapes import uncontrolled

TERMS = {
    "RT-LE": "root of the time-averaged squared localization error, in metres, per run and ego",
    "NEES": "normalised estimation error squared: 3 on average for a consistent filter of a position",
    "NIS": "normalised innovation squared per dimension: 1 on average for a consistent filter",
    "egos": "the vehicles whose positions a method estimates",
    "ego": "the vehicle whose position a method estimates",
    "GNSS": "satellite navigation: fixes of each vehicle's position",
    "V2X": "messages between vehicles, and between vehicles and road-side units",
    "OKF": "a Kalman filter whose noise parameters are trained on the error (Greenberg et al. 2023)",
    "KF": "Kalman filter",
    "LKF-SA": "the paper's cooperative Kalman filter, which exchanges measurements in real time",
    "MSMV": "the paper's cooperative baseline that weighs neighbours by their variances; a reconstruction",
    "FedKalmanNet": "a KalmanNet trained by federated averaging over vehicles (arXiv 2411.05847)",
    "KalmanNet": "a Kalman filter whose gain is a trained net (Revach et al. 2022)",
    "GNC": "graduated non-convexity: a robust loss approached from a convex one",
    "CI": "covariance intersection: fusion that is consistent whatever the correlation",
    "Cramér-Rao bound": "no unbiased filter with the same information has a smaller mean squared error",
    "identity": "noise model: unit covariances, as the paper's baselines have",
    "fitted": "noise model: covariances estimated on the training recordings",
    "nominal": "noise model: the standard deviations that act",
    "consistent": "errors as large as the filter's covariance claims",
    "over-confident": "errors larger than the filter's covariance claims",
}
"""Term -> meaning, as docs/glossary.md has it at more length."""
_FOUND = re.compile(rf"(?<![\w-])({'|'.join(map(re.escape, sorted(TERMS, key=len, reverse=True)))})(?![\w-])")


def explained(text: object) -> Markup:
    """Text as HTML whose terms carry their meaning, each where it first stands.

    >>> explained("KF < KF")
    Markup('<abbr title="Kalman filter">KF</abbr> &lt; KF')
    """
    seen: set[str] = set()

    def one(match: re.Match[str]) -> str:
        term = match[0]
        if term in seen:
            return term
        seen.add(term)
        return f'<abbr title="{escape(TERMS[term])}">{term}</abbr>'

    return Markup(_FOUND.sub(one, str(escape(uncontrolled(str(text))))))
