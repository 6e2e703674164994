"""Networks: shapes, equal results along every path, sharing, and what beta may and may not change."""

import copy
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rcdsac_trl.agent.actor import build_actor, build_critic, build_policy
from rcdsac_trl.agent.kernels import dispatch, feature_kernels, quantile_kernels, quantile_values
from rcdsac_trl.agent.kernels.dispatch import FEW_OBSERVATIONS
from rcdsac_trl.agent.kernels.observation_features import observation_features
from rcdsac_trl.agent.kernels.recurrent_kernels import _GatedRecurrence, gated_recurrence
from rcdsac_trl.agent.networks import (
    ActorHead,
    Encoder,
    LookAhead,
    NetworkSettings,
    QuantileHead,
    RangeFeatures,
    ScalarHead,
)
from rcdsac_trl.agent.risk import CVaR, PowerLaw
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.look_ahead import FORESEEN_SIZE, look_ahead
from rcdsac_trl.robot.observation import REMEMBERED_SIZE, VECTOR_OBSERVATIONS
from rcdsac_trl.robot.ring import Padding

SMALL = NetworkSettings(conv=4, range=8, vector=4, memory=6, head=5, cosines=7)
VECTORS = {**VECTOR_OBSERVATIONS, "collision_weight": 1}


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def observations(*lead: int) -> TensorDict:
    content = {"range": torch.rand(*lead, 180)} | {key: torch.randn(*lead, size) for key, size in VECTORS.items()}
    content["risk"] = -2.0 * torch.rand(*lead, 1)
    return TensorDict(content, batch_size=lead)


def gradients(output: Tensor, inputs: list[Tensor]) -> list[Tensor]:
    weights = torch.linspace(-1.0, 1.0, output.numel(), dtype=output.dtype).view_as(output)
    return list(torch.autograd.grad((output * weights).sum(), inputs, retain_graph=True))


# ------------------------------------------------------------------------------------------------ kernels
BLOCK = feature_kernels.ROWS_PER_BLOCK // 43
NARROW = [*range(21), *range(158, 180)]


def range_by_kernels(module: RangeFeatures, bins: Tensor) -> Tensor:
    return observation_features(module.read(bins), [], (module.conv_1, module.conv_2, module.linear), [])


@pytest.mark.parametrize("number", [FEW_OBSERVATIONS, BLOCK, 2 * BLOCK + 3])
@pytest.mark.parametrize("active", [list(range(180)), NARROW, [90], list(range(9, 180, 10)), []])
@pytest.mark.parametrize("padding", ["circular", "none"])
def test_range_features_equal_the_layers(number: int, active: list[int], padding: Padding) -> None:
    module = RangeFeatures(6, 16, padding).double()
    bins = torch.zeros(number, 180, dtype=torch.float64)
    bins[:, active] = torch.rand(number, len(active), dtype=torch.float64)
    fast, plain = range_by_kernels(module, bins), module(bins)
    torch.testing.assert_close(fast, plain)
    parameters = list(module.parameters())
    torch.testing.assert_close(gradients(fast, parameters), gradients(plain, parameters))
    with torch.no_grad():
        torch.testing.assert_close(range_by_kernels(module, bins), plain)


def test_inactive_bins_are_left_out() -> None:
    bins = np.zeros((3, 180), np.float32)
    assert feature_kernels.active_positions(bins + 1.0, 5).tolist() == list(range(43))
    # Bins 0..20 reach positions 0..10 of the first convolution and 0..5 of the second; 158..179 reach 77..87, 38..42.
    bins[1, NARROW] = 1.0
    assert feature_kernels.active_positions(bins, 5).tolist() == [*range(6), *range(38, 43)]
    # Bin 0 reaches position 0, bin 14 reaches 2 and 3.
    assert feature_kernels.active_positions(np.eye(180, dtype=np.float32)[[0, 14]], 5).tolist() == [0, 2, 3]
    assert feature_kernels.active_positions(0.0 * bins, 5).tolist() == [0]


@pytest.mark.parametrize(("rows", "steps"), [(1, 1), (1, 4), (3, 1), (5, 6)])
def test_gated_recurrence_equals_torchs(rows: int, steps: int) -> None:
    gru = nn.GRU(7, 5).double()
    inputs = torch.randn(steps, rows, 7, dtype=torch.float64, requires_grad=True)
    fast, plain = gated_recurrence(inputs, gru), gru(inputs)[0]
    torch.testing.assert_close(fast, plain)
    learned = [inputs, *gru.parameters()]
    torch.testing.assert_close(gradients(fast, learned), gradients(plain, learned))


def test_gated_recurrence_against_finite_differences() -> None:
    gru = nn.GRU(3, 2).double()
    inputs = torch.randn(3, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(_GatedRecurrence.apply, (inputs, *gru.parameters()))


Inputs = tuple[Tensor, Tensor, Tensor, Tensor | None]


def quantile_head(
    steps: int, tau_steps: int, risk_steps: int | None, *, frozen: bool = False, sequences: int | None = None
) -> tuple[QuantileHead, Inputs]:
    """Make a head and its kernel's inputs: memory, action, fractions, beta's cosines (None: not conditioned on it)."""
    head = QuantileHead(2, SMALL, None if risk_steps is None else PowerLaw()).double().requires_grad_(not frozen)
    sequences = sequences or 1 + quantile_kernels.ROWS_PER_BLOCK // (4 * steps)  # more than a block of products
    memory = torch.randn(steps, sequences, SMALL.memory, dtype=torch.float64).transpose(0, 1).requires_grad_()
    action = torch.randn(sequences, steps, 2, dtype=torch.float64, requires_grad=True)
    tau = torch.rand(sequences, tau_steps, 4, dtype=torch.float64)
    beta = None if risk_steps is None else torch.randn(sequences, risk_steps, SMALL.cosines, dtype=torch.float64)
    return head, (memory, action, tau, beta)


def by_kernels(head: QuantileHead, inputs: Inputs) -> Tensor:
    gate_beta = None if head.measure is None else head.gate_beta
    layers = quantile_values.HeadLayers(head.input, head.gate_tau, gate_beta, head.hidden, head.output)
    return quantile_values.quantile_values(*inputs, head.cosines.frequencies, layers)


@pytest.mark.parametrize("steps", [1, 3, 300])
@pytest.mark.parametrize("tau_shared", [True, False])
@pytest.mark.parametrize("risk", ["shared", "each", "none"])
@pytest.mark.parametrize("frozen", [True, False])
def test_quantile_values_equal_the_layers(steps: int, tau_shared: bool, risk: str, frozen: bool) -> None:
    risk_steps = {"shared": 1, "each": steps, "none": None}[risk]
    head, inputs = quantile_head(steps, 1 if tau_shared else steps, risk_steps, frozen=frozen)
    fast, plain = by_kernels(head, inputs), head.layers(*inputs)
    torch.testing.assert_close(fast, plain)
    learned = [*inputs[:2], *(() if frozen else head.parameters())]
    torch.testing.assert_close(gradients(fast, learned), gradients(plain, learned))
    chosen = torch.rand(*fast.shape[:2], 1) < 0.5  # as where the smaller of two critics counts
    torch.testing.assert_close(gradients(fast * chosen, learned), gradients(plain * chosen, learned))
    if frozen:
        never = gradients(0.0 * fast, learned)
        assert all(not value.any() for value in never)
    with torch.no_grad():
        torch.testing.assert_close(by_kernels(head, inputs), plain)


@pytest.mark.parametrize("risk_steps", [1, 2, None])
def test_quantile_values_against_finite_differences(risk_steps: int | None) -> None:
    head, inputs = quantile_head(2, 1, risk_steps, sequences=2)
    names = ("input", "gate_tau", "hidden", "output")
    parameters = [
        *(p for name in names[:2] for p in getattr(head, name).parameters()),
        None if risk_steps is None else head.gate_beta.weight,
        *(p for name in names[2:] for p in getattr(head, name).parameters()),
    ]
    apply = quantile_values._QuantileValues.apply
    assert torch.autograd.gradcheck(apply, (*inputs, head.cosines.frequencies, *parameters))


def test_range_features_export_as_plain_layers() -> None:
    module = RangeFeatures(4, 8).eval()
    bins = torch.rand(3, 180)
    exported = torch.export.export(module, (bins,))
    assert any("conv1d" in str(node.target) for node in exported.graph.nodes)
    torch.testing.assert_close(exported.module()(bins), module(bins))


# ------------------------------------------------------------------------------------------------ encoder
def test_encoder_shapes() -> None:
    batch = observations(3, 9)
    encoder = Encoder(VECTORS, NetworkSettings())
    inputs = [batch["range"], *(batch[key] for key in VECTORS)]
    assert encoder(*inputs).shape == (3, 9, 128)
    memory, state = encoder.step(*(x[:, 0] for x in inputs), torch.ones(3, 1, dtype=torch.bool), torch.zeros(3, 128))
    assert memory.shape == state.shape == (3, 128)


@pytest.mark.parametrize("lead", [(10,), (2, 5), (1,), ()])
def test_steps_equal_the_sequence(lead: tuple[int, ...]) -> None:
    """Step by step with carried memory is the sequence mode, and `is_init` is a fresh sequence."""
    steps, restart = 7, 4
    encoder = Encoder(VECTORS, NetworkSettings())
    batch = observations(max(1, torch.Size(lead).numel()), steps)
    inputs = [batch["range"], *(batch[key] for key in VECTORS)]
    whole = encoder(*inputs)
    fresh = encoder(*(x[:, restart:] for x in inputs))
    for restarted in (False, True):
        state = torch.full((*lead, 128), 0.5)  # leftovers of another episode
        for t in range(steps):
            is_init = torch.full((*lead, 1), t == 0 or (restarted and t == restart))
            memory, state = encoder.step(*(x[:, t].reshape(*lead, -1) for x in inputs), is_init, state)
            expected = fresh[:, t - restart] if restarted and t >= restart else whole[:, t]
            torch.testing.assert_close(memory.reshape(-1, 128), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("lead", [(40,), (2,), ()])  # more than a few go through the compiled twins
def test_with_restarts_a_memory_looks_back_as_far_as_training_unrolls(lead: tuple[int, ...]) -> None:
    """Every memory is that of the sequence which begins where the older of the two states did."""
    steps, restart_steps, begins = 13, 3, 9
    encoder = Encoder(VECTORS, replace(SMALL, restart_steps=restart_steps))
    plain = Encoder(VECTORS, SMALL)
    plain.load_state_dict(encoder.state_dict())
    number = torch.Size(lead).numel()
    batch = observations(number, steps)
    inputs = [batch["range"], *(batch[key] for key in VECTORS)]
    expected = []
    for t in range(steps):
        first = max(0, t // restart_steps - 1) * restart_steps
        assert t < restart_steps or restart_steps < t + 1 - first <= 2 * restart_steps
        expected.append(plain(*(x[:, first : t + 1] for x in inputs))[:, -1])
    for restarted in (False, True):  # an episode that begins is a fresh sequence
        state = torch.full((*lead, encoder.state_size), 7.0)
        for t in range(steps):
            is_init = torch.full((*lead, 1), t == 0 or (restarted and t == begins))
            memory, state = dispatch.step(encoder, *(x[:, t].reshape(*lead, -1) for x in inputs), is_init, state)
            found = memory.reshape(number, -1)
            if restarted and t >= begins:
                torch.testing.assert_close(found, plain(*(x[:, begins : t + 1] for x in inputs))[:, -1])
            else:
                torch.testing.assert_close(found, expected[t])
    for whole in (encoder(*inputs), dispatch.forward(encoder, *inputs)):
        torch.testing.assert_close(whole, torch.stack(expected, 1))
    unrolled = [x[:, : 2 * restart_steps + 1] for x in inputs]
    torch.testing.assert_close(encoder(*unrolled), plain(*unrolled))


def test_only_the_agents_that_begin_are_zeroed() -> None:
    encoder = Encoder(VECTORS, SMALL)
    batch = observations(2)
    inputs = [batch["range"], *(batch[key] for key in VECTORS)]
    one, _ = encoder.step(*inputs, torch.tensor([[True], [False]]), torch.ones(2, SMALL.memory))
    none, _ = encoder.step(*inputs, torch.zeros(2, 1, dtype=torch.bool), torch.ones(2, SMALL.memory))
    assert torch.equal(one[1], none[1])
    assert not torch.equal(one[0], none[0])


# ------------------------------------------------------------------------------------------------ heads
def test_head_shapes_and_bounds() -> None:
    memory, action = 100.0 * torch.randn(3, 8, 128), torch.rand(3, 8, 2)
    loc, scale = ActorHead(2, NetworkSettings(), CVaR())(memory, torch.rand(3, 1, 1))
    assert loc.shape == scale.shape == (3, 8, 2)
    assert scale.min() >= torch.tensor(-20.0).exp()
    assert scale.max() <= torch.tensor(2.0).exp()
    for tau_steps, risk_steps in [(1, 1), (1, 8), (8, 1), (8, 8)]:
        head = QuantileHead(2, NetworkSettings(), CVaR())
        quantiles = head(memory, action, torch.rand(3, tau_steps, 16), torch.rand(3, risk_steps, 1))
        assert quantiles.shape == (3, 8, 16)
    assert ScalarHead(2, NetworkSettings())(memory, action).shape == (3, 8, 1)


def test_broadcast_conditions_equal_repeated_ones() -> None:
    head = QuantileHead(2, SMALL, PowerLaw())
    memory, action = torch.randn(3, 8, SMALL.memory), torch.rand(3, 8, 2)
    tau, risk = torch.rand(3, 1, 4), -torch.rand(3, 1, 1)
    torch.testing.assert_close(
        head(memory, action, tau, risk), head(memory, action, tau.expand(3, 8, 4), risk.expand(3, 8, 1))
    )


def test_split_gate_is_one_layer_on_both_embeddings() -> None:
    """The quantile head by the paper's formula, with the gate's layer on the concatenation [beta; tau]."""
    measure = PowerLaw()
    head = QuantileHead(2, SMALL, measure)
    memory, action = torch.randn(2, 3, SMALL.memory), torch.rand(2, 3, 2)
    tau, risk = torch.rand(2, 3, 4), -2.0 * torch.rand(2, 3, 1)
    i = torch.arange(1, SMALL.cosines + 1)
    phi_beta = torch.cos(torch.pi * i * (-risk / 2.0)).unsqueeze(2).expand(2, 3, 4, -1)
    phi_tau = torch.cos(torch.pi * i * tau.unsqueeze(-1))
    weight = torch.cat((head.gate_beta.weight, head.gate_tau.weight), dim=1)
    gate = F.relu(F.linear(torch.cat((phi_beta, phi_tau), dim=-1), weight, head.gate_tau.bias))
    x = F.relu(head.input(torch.cat((memory, action), dim=-1))).unsqueeze(2)
    expected = head.output(F.relu(head.hidden(x * gate))).squeeze(-1)
    torch.testing.assert_close(head(memory, action, tau, risk), expected)


def test_beta_matters_only_with_a_gate() -> None:
    memory, action, tau = torch.randn(1, 4, 6).expand(2, 4, 6), torch.rand(1, 4, 2).expand(2, 4, 2), torch.rand(1, 1, 3)
    # A pair that cos(pi i beta) of the raw value cannot tell apart.
    risk = torch.tensor([-0.5, -1.5]).view(2, 1, 1)
    for measure, differs in ((PowerLaw(), True), (None, False)):
        loc, scale = ActorHead(2, SMALL, measure)(memory, risk)
        quantiles = QuantileHead(2, SMALL, measure)(memory, action, tau.expand(2, 1, 3), risk)
        for output in (loc, scale, quantiles):
            assert torch.equal(output[0], output[1]) is not differs


def test_conditioned_heads_ask_for_risk() -> None:
    memory = torch.randn(1, 1, 6)
    with pytest.raises(ValueError, match="conditioned on risk"):
        ActorHead(2, SMALL, CVaR())(memory)
    with pytest.raises(ValueError, match="conditioned on risk"):
        QuantileHead(2, SMALL, CVaR())(memory, torch.rand(1, 1, 2), torch.rand(1, 1, 3))


# ------------------------------------------------------------------------------------------------ look ahead
AHEAD = replace(SMALL, look_ahead=True, restart_steps=2)
WITH_MEMORY = {**VECTOR_OBSERVATIONS, "remembered": REMEMBERED_SIZE, "collision_weight": 1}


def test_look_ahead_is_that_of_the_robot_and_its_slopes_are_right() -> None:
    memory, action = torch.rand(3, 4, 7 + FORESEEN_SIZE), 2.0 * torch.rand(3, 4, 2) - 1.0
    expected = [
        look_ahead(m, u) for m, u in zip(memory.flatten(0, 1).numpy(), action.flatten(0, 1).numpy(), strict=True)
    ]
    told = LookAhead()(memory, action)
    np.testing.assert_allclose(told.flatten(0, 1).numpy(), expected, atol=1e-6)
    inputs = (memory.double().requires_grad_(), action.double().requires_grad_())
    assert torch.autograd.gradcheck(LookAhead().double(), inputs)


@pytest.mark.parametrize("sequences", [2, 20])  # more than a few go through the compiled twins
def test_heads_read_the_foreseen_clearances_of_the_newest_observation(sequences: int) -> None:
    sizes = {"range": 180, **WITH_MEMORY}
    inputs = [torch.rand(sequences, 4, size) for size in sizes.values()]
    encoder, plain = Encoder(WITH_MEMORY, AHEAD), Encoder(WITH_MEMORY, replace(AHEAD, look_ahead=False))
    plain.load_state_dict(encoder.state_dict())
    memory = dispatch.forward(encoder, *inputs)
    assert memory.shape[-1] == encoder.memory_size == Encoder.memory_size_of(AHEAD) == SMALL.memory + FORESEEN_SIZE
    torch.testing.assert_close(memory[..., : SMALL.memory], plain(*inputs))
    assert torch.equal(memory[..., SMALL.memory :], inputs[3][..., -FORESEEN_SIZE:])
    state = torch.zeros(sequences, AHEAD.state_size)
    for t in range(4):
        is_init = torch.full((sequences, 1), t == 0)
        read, state = dispatch.step(encoder, *(x[:, t] for x in inputs), is_init, state)
        torch.testing.assert_close(read, memory[:, t])


@pytest.mark.parametrize("kind", ["quantile", "scalar"])
def test_a_critic_is_told_how_near_its_action_leads(kind: Literal["quantile", "scalar"]) -> None:
    """Its value moves with what is foreseen of the action, along a slope that its compiled twin has, too."""
    measure = PowerLaw() if kind == "quantile" else None
    head = build_critic(2, WITH_MEMORY, kind, measure, AHEAD)[1].module.double()
    memory = torch.rand(3, 4, SMALL.memory + FORESEEN_SIZE).double()
    action = (2.0 * torch.rand(3, 4, 2) - 1.0).double().requires_grad_()
    told = [] if measure is None else [torch.rand(3, 1, 5).double(), -torch.rand(3, 1, 1).double()]
    plain, fast = head(memory, action, *told), dispatch.forward(head, memory, action, *told)
    torch.testing.assert_close(fast, plain)
    torch.testing.assert_close(gradients(fast, [action]), gradients(plain, [action]))
    assert torch.autograd.gradcheck(lambda u: head(memory, u, *told), (action,))
    with torch.no_grad():
        head.input.weight[:, -2:] = 0.0
    assert not torch.allclose(head(memory, action, *told), plain)


def test_who_looks_ahead_needs_a_memory_and_our_encoder() -> None:
    with pytest.raises(UserInputError, match=r"set sensor\.memory_s above 0"):
        Encoder(VECTORS, AHEAD)
    with pytest.raises(UserInputError, match=r"set it to false with network\.encoder=encoders\."):
        NetworkSettings(look_ahead=True, encoder="encoders.TwoLayers")


# ------------------------------------------------------------------------------------------------ keys
def test_actor_and_critics_read_and_write_their_keys() -> None:
    batch = observations(3, 5).set("action", torch.rand(3, 5, 2)).set("tau", torch.rand(3, 5, 4))
    actor = build_actor(2, VECTORS, CVaR(), SMALL)
    assert actor.in_keys == ["range", "waypoint", "velocity", "collision_weight", "risk"]
    assert actor(batch.clone())["loc"].shape == (3, 5, 2)
    assert build_actor(2, VECTOR_OBSERVATIONS, None, SMALL).in_keys == ["range", "waypoint", "velocity"]
    quantile = build_critic(2, VECTORS, "quantile", CVaR(), SMALL)
    assert quantile(batch.clone())["quantiles"].shape == (3, 5, 4)
    assert "risk" not in build_critic(2, VECTOR_OBSERVATIONS, "quantile", None, SMALL).in_keys
    scalar = build_critic(2, VECTORS, "scalar", None, SMALL)
    assert scalar(batch.clone())["state_action_value"].shape == (3, 5, 1)


def acting_inputs(*lead: int) -> TensorDict:
    batch = observations(*lead)
    batch["is_init"] = torch.zeros(*lead, 1, dtype=torch.bool)
    batch["recurrent_state"] = torch.randn(*lead, SMALL.memory)
    return batch


@pytest.mark.parametrize("lead", [(10,), (2, 5), ()])
@pytest.mark.parametrize("measure", [None, PowerLaw()])
def test_policy_acts_on_any_batch(lead: tuple[int, ...], measure: PowerLaw | None) -> None:
    policy = build_policy(build_actor(2, VECTORS, measure, SMALL), Bounded(-1, 1, (*lead, 2)))
    out = policy(acting_inputs(*lead))
    assert out["action"].shape == out["loc"].shape == (*lead, 2)
    assert out["next", "recurrent_state"].shape == (*lead, SMALL.memory)
    assert out["action"].abs().max() <= 1.0
    assert "memory" not in out
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        out = policy(acting_inputs(*lead))
    torch.testing.assert_close(out["action"], out["loc"].tanh())


def test_policy_shares_the_actors_parameters() -> None:
    actor = build_actor(2, VECTORS, PowerLaw(), SMALL)
    policy = build_policy(actor, Bounded(-1, 1, (2,)))
    assert {id(p) for p in policy.parameters()} == {id(p) for p in actor.parameters()}
    inputs = acting_inputs(4)
    before = policy(inputs.clone())["loc"]
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.1)
    assert not torch.equal(policy(inputs.clone())["loc"], before)


def test_policy_noise_comes_from_its_generator() -> None:
    actor = build_actor(2, VECTORS, PowerLaw(), SMALL)
    inputs, before = acting_inputs(4), torch.random.get_rng_state()
    actions = []
    for seed in (1, 1, 2):
        policy = build_policy(actor, Bounded(-1, 1, (4, 2)), torch.Generator().manual_seed(seed))
        actions.append(policy(inputs.clone())["action"])
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[0], actions[2])
    assert torch.equal(torch.random.get_rng_state(), before)


def test_agents_of_one_batch_do_not_mix() -> None:
    policy = build_policy(build_actor(2, VECTORS, PowerLaw(), SMALL), Bounded(-1, 1, (2,)))
    inputs = acting_inputs(4)
    before = policy(inputs.clone())["loc"]
    changed = inputs.clone()
    for key in ("range", "risk", "recurrent_state"):
        changed[key][2] *= 0.5
    after = policy(changed)["loc"]
    assert [torch.allclose(a, b) for a, b in zip(before, after, strict=True)] == [True, True, False, True]


def test_networks_copy() -> None:
    actor = build_actor(2, VECTORS, PowerLaw(), SMALL)
    batch = observations(2, 3)
    torch.testing.assert_close(copy.deepcopy(actor)(batch.clone())["loc"], actor(batch.clone())["loc"])


def test_wrong_choices() -> None:
    with pytest.raises(UserInputError, match="there is no critic 'mean'"):
        build_critic(kind="mean")  # type: ignore[arg-type]
    with pytest.raises(UserInputError, match="scalar critic cannot be conditioned"):
        build_critic(kind="scalar", measure=CVaR())
    with pytest.raises(UserInputError, match="network width head = 0"):
        NetworkSettings(head=0)
