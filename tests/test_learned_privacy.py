"""Privacy against closed forms, integrals and an audit; masks against RFC vectors; attacks against scipy."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import dp_accounting
import numpy as np
import pytest
import torch
from dp_accounting.rdp import RdpAccountant
from scipy import stats
from scipy.integrate import quad
from scipy.optimize import brentq

from coopoc import Fleet, InputError
from coopoc.errors import MissingLibraryError
from coopoc.learned import Client, GainNet, Schedule, Segments, clients, federate
from coopoc.learned.federation.aggregate import rule
from coopoc.learned.federation.means import mean
from coopoc.learned.federation.server_rules import FedAvgM
from coopoc.learned.nets.stack import flatten
from coopoc.learned.privacy import masks
from coopoc.learned.privacy.differential import Privacy, auc_bound, epsilon, noise_for
from coopoc.learned.privacy.masks import RESOLUTION, decode, encode, pair_seed, prg, public_key
from coopoc.learned.privacy.membership_inference import (
    AttackResult,
    gradient_scores,
    loss_scores,
    membership_inference,
    renoised,
)
from coopoc.learned.privacy.secure import SHARE, STAGES, Party, SecureAggregation, secure_sum, traffic, unmask
from coopoc.learned.privacy.shamir import PRIME, join, split

DELTA = 1e-5
phi = stats.norm.cdf


def drives(vehicles: int = 3, steps: int = 130) -> Fleet:
    t = np.arange(steps) / 10
    wave = t[:, None] / 4 + np.arange(vehicles)
    velocity = np.stack([9 * np.cos(wave), 9 * np.sin(wave), 0.1 + 0 * wave], axis=-1)
    return Fleet(tuple(f"c{i}" for i in range(vehicles)), t, np.cumsum(0.1 * velocity, axis=0), velocity)


def small() -> GainNet:
    return GainNet(2, 1)


# Epsilon


def gaussian_delta(z: float, eps: float) -> float:
    """Balle and Wang 2018, theorem 8, for sensitivity 1 and noise z."""
    return float(phi(0.5 / z - eps * z) - math.exp(eps) * phi(-0.5 / z - eps * z))


@pytest.mark.parametrize(("z", "rounds"), [(0.5, 1), (1.0, 1), (4.0, 1), (4.0, 20), (16.7, 20), (2.0, 7)])
def test_epsilon_is_that_of_one_gaussian(z: float, rounds: int) -> None:
    """T rounds of noise z are one of noise z / sqrt(T), whose delta is known in closed form."""
    found = epsilon(z, rounds)
    assert gaussian_delta(z / math.sqrt(rounds), found) == pytest.approx(DELTA, rel=1e-6)
    rdp = RdpAccountant().compose(dp_accounting.SelfComposedDpEvent(dp_accounting.GaussianDpEvent(z), rounds))
    assert found <= rdp.get_epsilon(DELTA) < 1.5 * found + 0.1


@pytest.mark.parametrize(("z", "share"), [(1.0, 0.3), (0.7, 0.5)])
def test_sampling_is_priced_by_integration(z: float, share: float) -> None:
    """One sampled round: delta is the larger integral of (p - e^eps q)+ over the two orders of the pair
    (1 - q) N(0, z^2) + q N(1, z^2) and N(0, z^2), which scipy integrates."""

    def pair(x: float) -> tuple[float, float]:
        without, shifted = (math.exp(-((x - m) ** 2) / (2 * z * z)) / (z * math.sqrt(2 * math.pi)) for m in (0, 1))
        return (1 - share) * without + share * shifted, without

    def delta(eps: float) -> float:
        ways = [lambda x: pair(x)[0] - math.exp(eps) * pair(x)[1], lambda x: pair(x)[1] - math.exp(eps) * pair(x)[0]]
        ends, places = (-12 * z, 12 * z + 1), np.linspace(-5 * z, 5 * z + 1, 9).tolist()
        return max(quad(lambda x, f=f: max(f(x), 0.0), *ends, points=places, limit=400)[0] for f in ways)

    exact = brentq(lambda eps: delta(eps) - DELTA, 1e-3, 40, xtol=1e-4)
    assert exact - 2e-3 <= epsilon(z, 1, share) <= 1.01 * exact + 2e-3


def test_noise_is_the_inverse_of_epsilon() -> None:
    for share in (1.0, 0.5):
        z = noise_for(3.0, 10, share)
        assert epsilon(z, 10, share) == pytest.approx(3.0, abs=1e-3)
    assert noise_for(3.0, 10, 0.5) < noise_for(3.0, 10)
    assert noise_for(math.inf, 10) == 0.0
    assert epsilon(0.0, 10) == math.inf


def test_the_ceiling_is_the_auc_of_the_best_attack() -> None:
    """A client's clip among the noise of T rounds, distinguished from noise alone by their sum: the U statistic of
    scipy."""
    noise = np.random.default_rng(0).normal(0, 3.0, (2, 4000, 9)).sum(-1)
    found = stats.mannwhitneyu(noise[0] + 9.0, noise[1]).statistic / 4000**2
    assert auc_bound(3.0, 9) == pytest.approx(found, abs=0.015)
    assert auc_bound(0.0, 1) == 1.0


def test_an_audit_stays_below_the_promise() -> None:
    """6,000 rounds with and without one client's update: the best threshold's error rates, at 99.9 % confidence
    (Clopper and Pearson), imply less than epsilon at delta, and not much less."""
    privacy = Privacy(1.0, 1.0, clients=2)
    rounds, delta = 6_000, 1e-2
    names = ["a", "b"]
    sums = [
        np.array(
            [
                float(privacy.protect(torch.tensor([[first], [-7.0]]), names, seed, 1).sum())
                for seed in range(begin, begin + rounds)
            ]
        )
        for first, begin in ((0.0, 0), (50.0, rounds))
    ]
    promised = epsilon(1.0, 1, 1.0, delta)
    seen = []
    for threshold in np.linspace(-1.0, 2.0, 31):
        hits, alarms = ((s > threshold).sum() for s in sums[::-1])
        low, high = stats.beta.ppf(1e-3, hits, rounds - hits + 1), stats.beta.ppf(0.999, alarms + 1, rounds - alarms)
        seen.append(math.log(max(low - delta, 1e-9) / high))
    assert 0.5 * promised < max(seen) < promised


# What leaves a client


def test_updates_are_clipped_and_their_sum_is_noised() -> None:
    updates = torch.stack([torch.full((20_000,), 1.0), torch.full((20_000,), 1e-6), torch.zeros(20_000)])
    clipped = Privacy(0.5, 0.0).protect(updates, ["a", "b", "c"], 0, 1)
    torch.testing.assert_close(clipped.norm(dim=1), torch.tensor([0.5, 1e-6 * math.sqrt(20_000), 0.0]))
    torch.testing.assert_close(clipped[0] / clipped[0].norm(), updates[0] / updates[0].norm())
    noise = (Privacy(0.5, 3.0).protect(updates, ["a", "b", "c"], 0, 1) - clipped).sum(0).numpy()
    square = float(np.square(noise / 1.5).sum())
    assert stats.chi2.ppf(1e-6, 20_000) < square < stats.chi2.ppf(1 - 1e-6, 20_000)
    assert stats.kstest(noise / 1.5, "norm").pvalue > 1e-6


def test_noise_belongs_to_client_round_and_seed() -> None:
    privacy, zeros = Privacy(1.0, 1.0, clients=3), torch.zeros(2, 8)
    first = privacy.protect(zeros, ["a", "b"], 0, 1)
    assert torch.equal(privacy.protect(zeros, ["b", "a"], 0, 1).flip(0), first)
    for seed, number, names in ((1, 1, ["a", "b"]), (0, 2, ["a", "b"]), (0, 1, ["c", "d"])):
        assert not torch.isclose(privacy.protect(zeros, names, seed, number), first).any()
    free = replace(privacy, keyed=False)
    assert not torch.isclose(free.protect(zeros, ["a", "b"], 0, 1), free.protect(zeros, ["a", "b"], 0, 1)).any()


def test_missing_clients_take_their_noise_with_them() -> None:
    """Three of four arrive: the sum's noise is z sqrt(3 / 4), and so is the price, by the closed form."""
    privacy = Privacy(1.0, 5.0, clients=4)
    sums = privacy.protect(torch.zeros(3, 50_000), ["a", "b", "c"], 0, 1).sum(0)
    assert float(sums.std()) == pytest.approx(5.0 * math.sqrt(3 / 4), rel=0.02)
    assert privacy.spent([3] * 6) == pytest.approx(epsilon(5.0 * math.sqrt(3 / 4), 6))
    assert privacy.spent([4] * 6) == pytest.approx(privacy.epsilon(6))
    assert privacy.spent([4, 0, 4]) == pytest.approx(privacy.epsilon(2))
    mixed = 1 / math.sqrt(2 / 25 + 1 / (25 * 2 / 4))
    assert gaussian_delta(mixed, privacy.spent([4, 2, 4])) == pytest.approx(DELTA, rel=1e-6)


@pytest.mark.parametrize(
    ("field", "call"),
    [
        ("clip", lambda: Privacy(0.0, 1.0)),
        ("noise_multiplier", lambda: Privacy(1.0, -1.0)),
        ("delta", lambda: Privacy(1.0, 1.0, delta=0.0)),
        ("clients", lambda: Privacy(1.0, 1.0, clients=0)),
        ("rounds", lambda: epsilon(1.0, 0)),
        ("share", lambda: epsilon(1.0, 1, 0.0)),
        ("epsilon", lambda: noise_for(0.0, 1)),
        ("aggregate", lambda: Privacy(1.0, 1.0).check("mean")),
        ("aggregate", lambda: Privacy(1.0, 1.0).check(SecureAggregation("fedadam"))),
        ("aggregate", lambda: SecureAggregation("median")),
        ("threshold", lambda: secure_sum(np.zeros((3, 2)), threshold=4)),
        ("update of client 1", lambda: secure_sum(np.array([[0.0], [np.nan], [0.0]]))),
        ("update of client 2", lambda: secure_sum(np.array([[0.0], [0.0], [-43.0]]))),
        ("threshold", lambda: split(1, 3, 4)),
        ("members", lambda: membership_inference(np.array([]), np.ones(3))),
        ("others", lambda: membership_inference(np.ones(3), np.array([np.nan]))),
    ],
)
def test_what_cannot_be_is_named(field: str, call: Callable[[], object]) -> None:
    with pytest.raises(InputError, match=field):
        call()


def test_an_absent_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dp_accounting", None)
    with pytest.raises(MissingLibraryError, match=r"dp-accounting.*coopoc\[privacy\]"):
        epsilon(1.2345, 1)
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.ciphers", None)
    masks._crypto.cache_clear()
    with pytest.raises(MissingLibraryError, match=r"cryptography.*coopoc\[privacy\]"):
        public_key(bytes(32))


def test_federate_with_privacy() -> None:
    """A wide clip without noise changes nothing; a clip bounds each round; noise repeats with its seed."""
    group, quick = clients(drives(), piece=10), Schedule(batch=4)

    def trained(privacy: Privacy | None, rounds: int = 2) -> list[torch.Tensor]:
        made = federate(small(), group, rounds, "uniform", 1, schedule=quick, privacy=privacy)
        return [row.weights for row in made.history]

    plain = trained(None)
    for ours, theirs in zip(trained(Privacy(1e6, 0.0)), plain, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6)
    bounded = trained(Privacy(0.01, 0.0))
    assert all(float((b - a).norm()) <= 0.0101 for a, b in pairwise(bounded))
    noised = trained(Privacy(0.01, 2.0))
    assert all(torch.equal(a, b) for a, b in zip(noised, trained(Privacy(0.01, 2.0)), strict=True))
    far = (noised[1] - bounded[1]) * 3 / 0.02
    assert stats.kstest(far.numpy(), "norm").pvalue > 1e-6
    with pytest.raises(InputError, match="aggregate"):
        federate(small(), group, 1, "mean", privacy=Privacy(1.0, 1.0))


# The secret sum


def test_keys_and_masks_are_those_of_the_standards() -> None:
    """X25519 with scalar and coordinate 9: RFC 7748, section 5.2, first iteration. ChaCha20's key stream of key, nonce
    and counter zero: RFC 8439, appendix A.1, test vector 1."""
    nine = (9).to_bytes(32, "little")
    assert public_key(nine).hex() == "422c8e7a6227d7bca1350b3e2bb7279f7897b87bb6854b783c60e80311ae3079"
    stream = "76b8e0ada0f13d90405d6ae55386bd28bdd219b8a08ded1aa836efcc8b770dc7"
    assert prg(bytes(32), 8).astype("<u4").tobytes().hex() == stream
    other = bytes(range(32))
    assert pair_seed(nine, public_key(other)) == pair_seed(other, public_key(nine))


def test_fixed_point_wraps_and_returns() -> None:
    values = np.array([-1.5, 0.0, 1e-9, 100.0, -100.0, np.pi])
    np.testing.assert_allclose(decode(encode(values)), values, atol=RESOLUTION / 2)
    assert decode(encode(values) + encode(-values)).tolist() == [0.0] * 6


@pytest.mark.parametrize(("clients", "size"), [(2, 5), (4, 300), (9, 64)])
def test_the_masked_sum_is_the_plain_sum(clients: int, size: int) -> None:
    values = np.random.default_rng(clients).normal(0, 2, (clients, size))
    found = secure_sum(values)
    np.testing.assert_allclose(found.total, values.sum(0), rtol=0, atol=clients / 2 * RESOLUTION)
    coarse = secure_sum(values, resolution=2.0**-10)
    np.testing.assert_allclose(coarse.total, values.sum(0), rtol=0, atol=clients / 2 * 2.0**-10)
    assert found.uploaded == list(range(clients))


def test_an_upload_is_uniform_and_says_nothing_of_the_update() -> None:
    """Bytes and words of the uploads of a constant and of a random update, by chi-square and correlation."""
    values = np.stack([np.full(40_000, 0.25), np.random.default_rng(0).normal(0, 1, 40_000), np.zeros(40_000)])
    for value, words in zip(values, secure_sum(values).seen, strict=True):
        counts = np.bincount(words.view(np.uint8), minlength=256)
        assert stats.chisquare(counts).pvalue > 1e-7
        assert stats.kstest(words / 2.0**32, "uniform").pvalue > 1e-7
        assert abs(np.corrcoef(words, value + 1e-9 * np.arange(40_000))[0, 1]) < 6 / math.sqrt(40_000)
    assert stats.chisquare(np.bincount(encode(values[1]).view(np.uint8), minlength=256)).pvalue < 1e-7


def test_shares_of_a_known_polynomial() -> None:
    """f(x) = 1234 + 166 x + 94 x^2, Shamir's scheme by hand."""
    points = {x: 1234 + 166 * x + 94 * x * x for x in (2, 4, 5)}
    assert join(points) == 1234
    shares = split(2**255 + 19, 6, 4)
    assert join({x: shares[x - 1] for x in (1, 3, 5, 6)}) == 2**255 + 19
    assert join({x: shares[x - 1] for x in (1, 3, 5)}) != 2**255 + 19
    assert PRIME.bit_length() <= 8 * SHARE


def test_too_few_shares_fit_every_secret() -> None:
    """Field of 11: with two of three shares each possible third one gives another secret, all of them; and the two
    shares of either secret are uniform on the 121 pairs."""
    for secret in (0, 7):
        two = np.array([split(secret, 3, 3, prime=11)[:2] for _ in range(12_100)])
        assert stats.chisquare(np.bincount(11 * two[:, 0] + two[:, 1], minlength=121)).pvalue > 1e-7
        first, second = two[0].tolist()
        assert {join({1: first, 2: second, 3: third}, 11) for third in range(11)} == set(range(11))


@pytest.mark.parametrize("stage", STAGES)
def test_clients_may_leave_at_every_stage(stage: str) -> None:
    """Who leaves before the upload is not in the sum, who leaves after it is; 4 of 6 are enough."""
    values = np.random.default_rng(1).normal(size=(6, 50))
    found = secure_sum(values, threshold=4, leaving={0: stage, 4: stage})  # type: ignore[dict-item]
    there = list(range(6)) if stage == "unmask" else [1, 2, 3, 5]
    assert found.uploaded == there
    np.testing.assert_allclose(found.total, values[there].sum(0), rtol=0, atol=3 * RESOLUTION)
    mixed = secure_sum(values, threshold=3, leaving={0: "shares", 2: "upload", 3: "unmask"})
    np.testing.assert_allclose(mixed.total, values[[1, 3, 4, 5]].sum(0), rtol=0, atol=3 * RESOLUTION)


@pytest.mark.parametrize(
    ("stage", "words"),
    [("keys", "sent keys"), ("shares", "sent shares"), ("upload", "uploaded"), ("unmask", "are left")],
)
def test_too_few_survivors_are_counted(stage: str, words: str) -> None:
    with pytest.raises(InputError, match=f"clients = 3: of them {words}, and 4 are needed"):
        secure_sum(np.zeros((5, 3)), leaving={1: stage, 2: stage})  # type: ignore[dict-item]


def played(late: int | None) -> tuple[dict[int, np.ndarray], dict[int, dict[int, int]], dict[int, Party], list[int]]:  # type: ignore[type-arg]
    """A protocol of four played by hand: uploads, what survivors reveal, the parties, and all message lengths."""
    parties = {x: Party(x, 3) for x in range(1, 5)}
    keys = {x: party.keys() for x, party in parties.items()}
    boxes = {x: party.shares(keys) for x, party in parties.items()}
    uploads = {x: p.upload(encode(np.full(7000, 0.5)), keys, sorted(boxes)) for x, p in parties.items()}
    uploaded = [x for x in parties if x != late]
    mine = {x: {sender: boxes[sender][x] for sender in boxes} for x in uploaded}
    revealed = {x: parties[x].reveal(mine[x], keys, uploaded) for x in uploaded}
    first = [
        len(keys[1].mask) + len(keys[1].box),
        sum(len(box) for x, box in boxes[1].items() if x != 1),
        uploads[1].nbytes,
        SHARE * len(revealed[1]),
    ]
    return uploads, revealed, parties, first


def test_traffic_is_the_length_of_the_messages() -> None:
    lengths = played(None)[3]
    sent, received = traffic(4, 7000)
    assert sent == [sum(lengths)] * 4
    assert received == [3 * 64 + lengths[1] + 1] * 4
    assert traffic(4, 7000, {2: "upload"})[0][2] == lengths[0] + lengths[1]


def test_a_late_upload_stays_hidden() -> None:
    """The server has declared client 2 absent and got its mask key; what then arrives is still uniform, under the own
    seed, of which the survivors' shares give nothing. The sum of the others is not disturbed."""
    uploads, revealed, parties, _ = played(late=2)
    keys = {x: party.keys() for x, party in parties.items()}
    shares = {x: shown[2] for x, shown in revealed.items()}
    key = join(shares).to_bytes(32)
    assert key == parties[2].mask_key
    bare = uploads[2].copy()
    for other in (1, 3, 4):
        pair = prg(pair_seed(key, keys[other].mask), 7000)
        bare += np.negative(pair) if other > 2 else pair
    np.testing.assert_array_equal(bare - prg(parties[2].own_seed, 7000), encode(np.full(7000, 0.5)))
    assert stats.chisquare(np.bincount(bare.view(np.uint8), minlength=256)).pvalue > 1e-7
    masks = unmask(revealed, keys, [1, 3, 4], 7000, 3)
    total = decode(np.sum([uploads[x] for x in (1, 3, 4)], axis=0, dtype=np.uint32) - masks)
    assert total.tolist() == [1.5] * 7000


def test_secure_aggregation_is_the_rule_that_it_hides() -> None:
    draw = torch.Generator().manual_seed(0)
    theta, weights = torch.randn(50, generator=draw), torch.randn(5, 50, generator=draw)
    sizes, losses = torch.tensor([12, 36, 11, 11, 3]), torch.ones(5)
    for name in ("mean", "uniform", "fedprox", "fedavgm", "fedadam"):
        ours, plain = SecureAggregation(name), rule(name)
        found, state = ours(ours.start(theta), theta, weights, sizes, losses)
        expected, kept = plain(plain.start(theta), theta, weights, sizes, losses)
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
        for a, b in zip(state, kept, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
    equal = SecureAggregation(FedAvgM(1.0, 0.0), equal=True)
    found = equal(equal.start(theta), theta, weights, sizes, losses)[0]
    torch.testing.assert_close(found, weights.mean(0), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(SecureAggregation()((), theta, weights, sizes, losses)[0], mean(weights, sizes))


def test_federate_with_masks_and_privacy() -> None:
    """The masks change each round by rounding only, and repeat although the keys are new."""
    group = clients(drives(), piece=10)
    made = [
        federate(small(), group, 2, aggregate, 1, schedule=Schedule(batch=4), privacy=Privacy(0.05, 1.0)).history[-1]
        for aggregate in ("uniform", SecureAggregation("uniform"), SecureAggregation("uniform"))
    ]
    torch.testing.assert_close(made[1].weights, made[0].weights, rtol=0, atol=1e-5)
    assert torch.equal(made[1].weights, made[2].weights)
    count = len(group)
    sent, received = traffic(count, sum(p.numel() for p in small().parameters()))
    four = 4 * sum(p.numel() for p in small().parameters())
    assert made[1].sent_bytes - made[0].sent_bytes == sum(sent) - count * four
    assert made[1].received_bytes - made[0].received_bytes == sum(received)


# Membership inference


def test_auc_is_that_of_mann_and_whitney() -> None:
    """Area by scipy's U; its interval by the standard error of Hanley and McNeil, 1982; exact at the ends."""
    draw = np.random.default_rng(3)
    members, others = draw.normal(0.8, 1, 150).round(1), draw.normal(0, 1, 200).round(1)
    found = membership_inference(members, others)
    u = stats.mannwhitneyu(members, others).statistic
    assert found.auc == pytest.approx(u / (150 * 200))
    a = found.auc
    q1, q2 = a / (2 - a), 2 * a * a / (1 + a)
    error = math.sqrt((a * (1 - a) + 149 * (q1 - a * a) + 199 * (q2 - a * a)) / (150 * 200))
    assert [found.low, found.high] == pytest.approx([a - 1.96 * error, a + 1.96 * error], abs=0.015)
    assert found.found == np.mean(members > np.sort(others)[-3])
    assert membership_inference(np.ones(3), np.zeros(4)) == AttackResult(1.0, 1.0, 1.0, 1.0, 3, 4)


@pytest.fixture(scope="module")
def overfitted() -> tuple[GainNet, Client, list[torch.Tensor]]:
    """A net that has seen four pieces of a drive 200 times, and the drive: four members, the rest unseen."""
    (client,) = clients(drives(1, 700), piece=20, split=0.13)
    schedule = Schedule(batch=4, learning_rate=0.01, weight_decay=0.0, mirror=False)
    model = GainNet(6, 2)
    made = federate(model, [client], 1, "uniform", 250, schedule=schedule)
    assert len(client.training) == 4
    return model, client, [row.weights for row in made.history]


def judged(seen: list[torch.Tensor], model: GainNet, members: Segments, others: Segments) -> list[AttackResult]:
    pairs = list(pairwise(seen))
    return [
        membership_inference(*(loss_scores(model, pairs, part) for part in (members, others))),
        membership_inference(*(gradient_scores(model, pairs, part, mirrors=False) for part in (members, others))),
    ]


def test_what_was_overfitted_is_found(overfitted: tuple[GainNet, Client, list[torch.Tensor]]) -> None:
    model, client, seen = overfitted
    by_loss, by_gradient = judged(seen, model, client.training, client.validation)
    assert by_loss.auc > 0.8
    assert by_gradient.auc > 0.6
    path = membership_inference(
        loss_scores(model, [(seen[0], seen[1])], client.training),
        loss_scores(model, [(seen[0], seen[1])], renoised(client.training)),
    )
    assert path.auc > 0.6


def test_noise_hides_it(overfitted: tuple[GainNet, Client, list[torch.Tensor]]) -> None:
    model, client, (before, after) = overfitted
    hidden = Privacy(0.5, 3.0).protect((after - before)[None], ["c0"], 0, 1)[0]
    for found in judged([before, before + hidden], model, client.training, client.validation):
        assert found.low <= 0.5 <= found.high


def test_what_was_never_trained_on_is_not_found(overfitted: tuple[GainNet, Client, list[torch.Tensor]]) -> None:
    model, client, seen = overfitted
    half = len(client.validation) // 2
    one, two = client.validation.take(range(half)), client.validation.take(range(half, 2 * half))
    for found in judged(seen, model, one, two):
        assert found.low <= 0.5 <= found.high


def test_a_gradient_points_at_its_own_step() -> None:
    """A step along the descent direction of one piece (torch's autograd) has cosine one with it, and less with others;
    mirrored forms are those of a piece whose axes are turned by hand."""
    (client,) = clients(drives(1), piece=10)
    model, pieces = small(), client.training
    theta = flatten([model]).requires_grad_()
    loss = model.losses(theta, pieces.batch(torch.tensor([[2]]))).mean()
    (gradient,) = torch.autograd.grad(loss, theta)
    step = (theta.detach()[0], theta.detach()[0] - 1e-3 * gradient[0])
    scores = gradient_scores(model, [step], pieces, mirrors=False)
    assert scores[2] == pytest.approx(1.0, abs=1e-4)
    assert np.delete(scores, 2).max() < 0.999
    signs = torch.tensor([1.0, -1.0, -1.0])
    turned = replace(pieces, **{k: getattr(pieces, k)[..., [1, 0, 2]] * signs for k in ("gnss", "velocity", "truth")})
    both = [gradient_scores(model, [step], part) for part in (pieces, turned)]
    np.testing.assert_allclose(*both, atol=1e-5)


def test_renoised_drives_are_the_same_paths() -> None:
    pieces = clients(drives(1, 2100), piece=20)[0].training
    again = renoised(pieces, 3)
    assert torch.equal(again.truth, pieces.truth)
    assert float((again.gnss - pieces.truth).std()) == pytest.approx(1.5, rel=0.05)
    moved = (again.velocity - pieces.true_velocity)[:, 1:, :2] / pieces.true_velocity[:, 1:, :2]
    assert float(moved.std()) == pytest.approx(0.1, rel=0.05)
    assert abs(np.corrcoef((again.gnss - pieces.gnss).flatten(), (again.gnss - again.truth).flatten())[0, 1]) < 0.8
