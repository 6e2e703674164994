"""Risk measures against closed forms, their dual densities and their own promises."""

import itertools
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from rcdsac_trl.agent.networks import CosineFeatures
from rcdsac_trl.agent.risk import (
    CPW,
    MEASURES,
    CVaR,
    Interval,
    Neutral,
    PowerLaw,
    RiskMeasure,
    VaR,
    Wang,
    WidePowerLaw,
    make_measure,
)
from rcdsac_trl.errors import UserInputError

# Midpoints of a fine partition of (0, 1): quadrature for every expectation over tau or u below.
NUMBER = 200_000
TAU = (torch.arange(NUMBER, dtype=torch.float64) + 0.5) / NUMBER
MEAN, DEVIATION = 1.5, 2.0

BETAS: dict[str, tuple[float, ...]] = {
    "neutral": (0.0,),
    "cvar": (0.01, 0.1, 0.25, 0.5, 0.75, 1.0),
    "pow": (-2.0, -1.5, -1.0, -0.5, -0.1, 0.0),
    "pow_wide": (-8.0, -4.0, -2.0, -1.0, -0.1, 0.0),
    "wang": (-2.0, -1.0, -0.3, 0.0, 0.5, 2.0),
    "cpw": (0.3, 0.5, 0.71, 0.9, 1.0),
    "var": (0.05, 0.25, 0.5, 0.95),
}
CASES = [(name, beta) for name, betas in BETAS.items() for beta in betas]


def as_tensor(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def normal_quantile(u: Tensor) -> Tensor:
    return MEAN + DEVIATION * torch.special.ndtri(u)


def value(measure: RiskMeasure, beta: float, quantile: Callable[[Tensor], Tensor] = normal_quantile) -> float:
    return float(quantile(measure.psi(TAU, as_tensor(beta))).mean())


def cdf(x: float) -> float:
    return float(torch.special.ndtr(as_tensor(x)))


def inverse_cdf(p: float) -> float:
    return float(torch.special.ndtri(as_tensor(p)))


def density(x: float) -> float:
    return math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


NORMAL = [
    (Neutral(), 0.0, 0.0),
    *((CVaR(), b, -density(inverse_cdf(b)) / b) for b in (0.1, 0.25, 0.5, 0.75)),
    (CVaR(), 1.0, 0.0),
    # An integer power law is the mean of the smallest of 1 - beta draws.
    (PowerLaw(), 0.0, 0.0),
    (PowerLaw(), -1.0, -1.0 / math.sqrt(math.pi)),
    (PowerLaw(), -2.0, -1.5 / math.sqrt(math.pi)),
    (WidePowerLaw(), -2.0, -1.5 / math.sqrt(math.pi)),
    (WidePowerLaw(), -8.0, -1.4850131),  # the mean of the smallest of nine, as tables of order statistics have it
    *((Wang(), b, b) for b in (-2.0, -0.5, 0.0, 1.0)),
    (CPW(), 1.0, 0.0),
    *((VaR(), b, inverse_cdf(b)) for b in (0.05, 0.5, 0.9)),
]


@pytest.mark.parametrize(("measure", "beta", "standard"), NORMAL, ids=lambda x: str(x))
def test_value_of_a_normal_return(measure: RiskMeasure, beta: float, standard: float) -> None:
    assert value(measure, beta) == pytest.approx(MEAN + DEVIATION * standard, abs=2e-4)


TWO_POINT = [
    (Neutral(), 0.0, lambda p: p),
    *((CVaR(), b, lambda p, b=b: min(p / b, 1.0)) for b in (0.1, 0.3, 1.0)),
    *((PowerLaw(), b, lambda p, b=b: 1.0 - (1.0 - p) ** (1.0 - b)) for b in (-2.0, -0.5, 0.0)),
    (WidePowerLaw(), -7.0, lambda p: 1.0 - (1.0 - p) ** 8),
    *((Wang(), b, lambda p, b=b: cdf(inverse_cdf(p) - b)) for b in (-1.5, 0.7)),
    *((VaR(), b, lambda p, b=b: float(b <= p)) for b in (0.1, 0.5)),
]


@pytest.mark.parametrize(("measure", "beta", "bad_share"), TWO_POINT)
@pytest.mark.parametrize("p", [0.05, 0.2, 0.6])
def test_value_of_a_two_point_return(
    measure: RiskMeasure, beta: float, bad_share: Callable[[float], float], p: float
) -> None:
    """A crash of -10 with probability p, else +1: the measure sees the crash with probability psi^-1(p)."""
    share = bad_share(p)
    found = value(measure, beta, lambda u: torch.where(u <= p, -10.0, 1.0).to(u.dtype))
    assert found == pytest.approx(-10.0 * share + 1.0 * (1.0 - share), abs=1e-3)


def test_cpw_by_hand() -> None:
    # psi(1/2; 1/2) = sqrt(1/2) / (2 sqrt(1/2))^2 = 2^(-3/2), so it sees that fraction as one half.
    p = 2.0**-1.5
    assert CPW().psi(as_tensor(0.5), as_tensor(0.5)).item() == pytest.approx(p, abs=1e-12)
    assert value(CPW(), 0.5, lambda u: (u > p).to(u.dtype)) == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize(("name", "beta"), CASES)
def test_psi_is_monotone_and_stays_a_fraction(name: str, beta: float) -> None:
    for dtype in (torch.float64, torch.float32):
        tau = torch.linspace(0.0, 1.0, 10_001, dtype=dtype)
        psi = MEASURES[name]().psi(tau, torch.tensor(beta, dtype=dtype))
        assert psi.dtype == dtype
        assert psi.shape == tau.shape
        assert ((psi >= 0.0) & (psi <= 1.0)).all()
        assert (psi.diff() >= (0.0 if dtype == torch.float64 else -1e-6)).all()


@pytest.mark.parametrize(("name", "beta"), CASES)
def test_psi_at_the_ends(name: str, beta: float) -> None:
    lowest, highest = MEASURES[name]().psi(torch.tensor([0.0, 1.0], dtype=torch.float64), as_tensor(beta)).tolist()
    assert lowest == pytest.approx(beta if name == "var" else 0.0)
    assert highest == pytest.approx(beta if name in ("var", "cvar") else 1.0)


@pytest.mark.parametrize("name", [n for n, m in MEASURES.items() if m.neutral_beta is not None])
def test_neutral_beta_distorts_nothing(name: str) -> None:
    measure = MEASURES[name]()
    tau = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    torch.testing.assert_close(measure.psi(tau, as_tensor(measure.neutral_beta or 0.0)), tau)


@pytest.mark.parametrize("name", ["cvar", "pow", "pow_wide", "wang", "var"])
def test_smaller_beta_is_more_averse(name: str) -> None:
    measure = MEASURES[name]()
    values = [value(measure, beta) for beta in BETAS[name]]
    assert all(low < high for low, high in itertools.pairwise(values))


def test_smaller_cpw_is_more_pessimistic_in_the_middle() -> None:
    medians = CPW().psi(as_tensor(0.5), torch.tensor(BETAS["cpw"], dtype=torch.float64))
    assert (medians.diff() > 0).all()


@pytest.mark.parametrize(("name", "beta"), [(n, b) for n, b in CASES if n not in ("cpw", "var")])
def test_dual_density_gives_the_same_value(name: str, beta: float) -> None:
    measure = MEASURES[name]()
    density_ = measure.weight(TAU, as_tensor(beta))
    assert density_.mean().item() == pytest.approx(1.0, abs=2e-3)
    dual = (density_ * normal_quantile(TAU)).mean().item()
    assert dual == pytest.approx(value(measure, beta), abs=3e-2)


# Weights of the values of a sorted sample.
SAMPLES = [
    (Neutral(), 0.0, [0.25, 0.25, 0.25, 0.25]),
    (CVaR(), 0.3, [2 / 3, 1 / 3, 0.0, 0.0, 0.0]),  # the lowest of five, and half of the next
    (CVaR(), 1.0, [1 / 3, 1 / 3, 1 / 3]),
    # The smallest of 1 - beta draws from the sample, with replacement.
    (PowerLaw(), -1.0, [5 / 9, 3 / 9, 1 / 9]),
    (PowerLaw(), -2.0, [7 / 8, 1 / 8]),
    (WidePowerLaw(), -5.0, [63 / 64, 1 / 64]),
    (Wang(), -1.0, [cdf(1.0), 1.0 - cdf(1.0)]),  # of two: psi maps that fraction to one half
    (VaR(), 0.5, [0.0, 1.0, 0.0, 0.0]),
]


@pytest.mark.parametrize(("measure", "beta", "weights"), SAMPLES)
def test_weights_of_a_sample_are_exact(measure: RiskMeasure, beta: float, weights: list[float]) -> None:
    u = torch.arange(len(weights) + 1, dtype=torch.float64) / len(weights)
    torch.testing.assert_close(
        measure.inverse_psi(u, as_tensor(beta)).diff(), torch.tensor(weights, dtype=torch.float64)
    )


@pytest.mark.parametrize(("name", "beta"), [case for case in CASES if case[0] not in ("cvar", "var")])
def test_the_inverse_of_psi_undoes_it(name: str, beta: float) -> None:
    measure, u = MEASURES[name](), torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    found = measure.inverse_psi(u, as_tensor(beta))
    told = found < 1.0 - 1e-9  # closer to 1 float64 has no digits left to undo
    torch.testing.assert_close(measure.psi(found, as_tensor(beta))[told], u[told])
    assert told[:86].all()


@pytest.mark.parametrize("name", ["cpw", "var"])
def test_no_dual_density_where_there_is_none(name: str) -> None:
    with pytest.raises(NotImplementedError):
        MEASURES[name]().weight(TAU[:2], as_tensor(0.5))


@pytest.mark.parametrize("name", [n for n in MEASURES if n != "neutral"])
def test_embeddings_of_all_betas_are_distinct(name: str) -> None:
    """Raw cos(pi i beta) on [-2, 0] cannot tell -0.5 from -1.5; what the networks see must."""
    measure = MEASURES[name]()
    for betas in (torch.linspace(measure.low, measure.high, 401), torch.tensor(sorted(BETAS[name]))):
        embedded = measure.embed(betas)
        assert ((embedded >= 0.0) & (embedded <= 1.0)).all()
        steps = embedded.diff()
        assert (steps > 0).all() or (steps < 0).all()
        features = CosineFeatures(64)(embedded)
        distances = torch.cdist(features, features) + 10.0 * torch.eye(len(betas))
        assert distances.min() > 0.01


def test_embeddings_by_hand() -> None:
    assert [PowerLaw().embed(b) for b in (0.0, -0.5, -2.0)] == [0.0, 0.25, 1.0]
    assert [WidePowerLaw().embed(b) for b in (0.0, -0.5, -8.0)] == [0.0, 0.0625, 1.0]
    assert CVaR().embed(0.25) == 0.25
    assert Wang().embed(-1.0) == 0.25


@pytest.mark.parametrize("name", list(MEASURES))
def test_samples_fill_the_range_and_repeat(name: str) -> None:
    measure = MEASURES[name]()
    draws = [measure.sample((50, 100), torch.Generator().manual_seed(7)) for _ in range(2)]
    assert torch.equal(*draws)
    assert draws[0].shape == (50, 100)
    assert draws[0].min() >= measure.low - 1e-6
    assert draws[0].max() <= measure.high
    # 1 / (2 - beta) is uniform over [0.1, 0.5] for the wide power law, beta itself for all others.
    mean = 2.0 - math.log(5.0) / 0.4 if name == "pow_wide" else 0.5 * (measure.low + measure.high)
    assert draws[0].mean().item() == pytest.approx(mean, abs=0.02 * (measure.high - measure.low) + 1e-9)
    assert measure.from_uniform(0.0) == measure.low
    for extreme in (draws[0].min(), draws[0].max()):
        assert torch.isfinite(measure.psi(torch.tensor([0.0, 0.3, 1.0 - 2.0**-24]), extreme)).all()


def test_draws_of_the_wide_power_law_look_at_all_shares_of_returns_alike() -> None:
    """The mean fraction that it looks at, 1 / (2 - beta), is uniform: over [0.1, 0.5], as that of CVaR from 0.2 on."""
    drawn = WidePowerLaw().sample((20_000,), torch.Generator().manual_seed(3))
    looked_at = (1.0 / (2.0 - drawn.double())).sort().values
    uniform = torch.linspace(0.1, 0.5, len(drawn), dtype=torch.float64)
    assert (looked_at - uniform).abs().max() < 0.4 * 0.015  # Kolmogorov-Smirnov: 1.95 / sqrt(20,000) at 0.1 %
    measure = WidePowerLaw(low=-3.0, high=-0.5)
    assert measure.from_uniform(0.5) == pytest.approx(2.0 - 1.0 / 0.3)  # 1/5 and 2/5 at the ends
    beta, tau = as_tensor(-3.0), TAU
    assert measure.psi(tau, beta).mean().item() == pytest.approx(0.2, abs=1e-6)


def test_sampled_range_is_a_setting() -> None:
    measure = make_measure("pow", low=-1.0, high=-0.5)
    drawn = measure.sample((1000,), torch.Generator().manual_seed(0))
    assert -1.0 <= drawn.min() < -0.95
    assert -0.55 < drawn.max() <= -0.5
    assert measure.embed(-1.0) == 0.5  # does not move with the range


def test_temper() -> None:
    assert [CVaR().temper(0.2, f) for f in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 0.6, 0.2])
    torch.testing.assert_close(PowerLaw().temper(torch.tensor([-2.0, 0.0]), 0.25), torch.tensor([-0.5, 0.0]))
    assert VaR().temper(0.3, 1.0) == 0.3
    with pytest.raises(UserInputError, match="'var' has no neutral beta"):
        VaR().temper(0.3, 0.5)


@pytest.mark.parametrize(
    ("measure", "bad", "domain"),
    [
        (CVaR(), 0.0, "(0, 1]"),
        (CVaR(), 1.1, "(0, 1]"),
        (PowerLaw(), -2.1, "[-2, 0]"),
        (PowerLaw(), 0.5, "[-2, 0]"),
        (VaR(), 1.0, "(0, 1)"),
        (CPW(), 0.2, "[0.3, 1]"),
        (Wang(), math.nan, "[-2, 2]"),
    ],
)
def test_beta_outside_the_domain(measure: RiskMeasure, bad: float, domain: str) -> None:
    with pytest.raises(UserInputError) as error:
        measure.check(bad)
    assert f"beta = {bad:g} is outside the domain {domain} of measure {measure.name!r}" in str(error.value)


@pytest.mark.parametrize(("name", "beta"), CASES)
def test_betas_inside_the_domain(name: str, beta: float) -> None:
    MEASURES[name]().check(beta)


def test_wrong_ranges_and_names() -> None:
    with pytest.raises(UserInputError, match="empty"):
        PowerLaw(low=-0.5, high=-1.0)
    with pytest.raises(UserInputError, match="outside the domain"):
        make_measure("cvar", low=0.0)
    with pytest.raises(UserInputError, match=r"no risk measure 'power'.*neutral, cvar, pow, pow_wide, wang, cpw, var"):
        make_measure("power")


def test_interval() -> None:
    assert str(Interval(0.0, 1.0, low_inclusive=False)) == "(0, 1]"
    assert 1.0 in Interval(0.0, 1.0)
    assert 0.0 not in Interval(0.0, 1.0, low_inclusive=False)
