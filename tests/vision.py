"""How colours are seen: contrasts and distances, also by colour-blind readers."""

import numpy as np

from rcdsac_trl.report.night import TO_CONES, TO_OKLAB, linear

# Machado, Oliveira and Fernandes (2009), severity 1: linear RGB to linear RGB.
BLINDNESS = {
    "none": np.eye(3),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def luminance(color: str) -> float:
    """Return the relative luminance of WCAG 2.2."""
    return float(linear(color) @ [0.2126, 0.7152, 0.0722])


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of WCAG 2.2."""
    darker, lighter = sorted(map(luminance, (one, other)))
    return (lighter + 0.05) / (darker + 0.05)


def apart(one: str, other: str, blindness: str) -> float:
    """Return the distance of two colours in OKLab, as such a reader sees them."""
    seen = [TO_OKLAB @ np.cbrt(TO_CONES @ np.clip(BLINDNESS[blindness] @ linear(c), 0.0, 1.0)) for c in (one, other)]
    return float(np.linalg.norm(seen[0] - seen[1]))
