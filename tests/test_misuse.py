"""Wrong calls of the public functions: each is refused with an error of ours that names the field, or has an answer."""

import inspect
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused

import coopoc as co
from coopoc import optimize
from coopoc.errors import shown
from coopoc.evaluate.ledger import of_track
from coopoc.evaluate.metrics import fix_innovations
from coopoc.formats import load_graph, read_g2o, read_pyfg
from coopoc.study.merge import merge
from coopoc.study.publish import views
from coopoc.study.reference import Reference
from coopoc.study.report import report

WRONG: tuple[Any, ...] = (
    None,
    "x",
    "",
    -1,
    0,
    1.5,
    True,
    10**30,
    float("inf"),
    float("nan"),
    [],
    {},
    [1, 2],
    ["a", "b"],
    [None],
    object(),
    b"x",
    np.ones((2, 2)),
    np.full(3, np.nan),
)
"""Values of the wrong kind, size or range; some are right for some fields."""
RAGGED: tuple[Any, ...] = ([[1], [2, 3]], np.datetime64("2024-01-01"), np.array([1, 2], object), 1 + 2j, [10**400] * 4)
"""Values that NumPy cannot turn into numbers, or whose comparisons are no truth values."""


class Foreign:
    """An object of a library of which nothing is known: it is no array, and has not even a text."""

    def __array__(self, *_given: Any, **_options: Any) -> Any:
        raise RuntimeError("no array")

    def __repr__(self) -> str:
        raise RuntimeError("no text")


HOSTILE: tuple[Any, ...] = (
    np.array(3),
    np.array("x"),
    np.array(None),
    pd.NA,
    pd.NaT,
    np.timedelta64(300, "ms"),
    np.ma.masked_array([1.0, 2.0, 3.0], [True, False, False]),
    [pd.NA],
    pd.Series([1, pd.NA]),
    Foreign(),
    10**400,
    "a" * 300,
    "a\0b",
    "\ud800",
    b"ab",
    {0, 1},
)
"""What pandas, masks, paths and libraries from elsewhere bring in."""
ALL = (*WRONG, *RAGGED, *HOSTILE)
FEW = (None, "x", -1, 0, 1.5, True, float("nan"), float("inf"), [], np.ones((2, 2)))
METHODS: tuple[Any, ...] = (
    co.GNSS,
    co.Kalman,
    co.AdaptiveKalman,
    co.JointFilter,
    co.LKFSA,
    co.MSMV,
    co.BatchSmoother,
    co.CentralFilter,
    co.CovarianceIntersection,
    co.GaussianBeliefPropagation,
)
FLEET = co.load_fleet("town10").between(0, 6).select([0, 1, 2, 3])
SENSORS, CHANNEL = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=3)
RECORDING = co.observe(FLEET, SENSORS, CHANNEL, runs=1, seed=0)
TRACK = co.Kalman("nominal")(RECORDING, [0, 1])


def ours(call: Callable[[], object], what: str) -> None:
    """The call has an answer, or ends in an error of ours."""
    try:
        call()
    except (co.InputError, co.MissingLibraryError):
        pass
    except Exception as error:
        pytest.fail(f"{what}: {type(error).__name__}: {error}")


BARE, OTHER = replace(TRACK, covariance=None), replace(RECORDING, ids=("e", "f", "g", "h"))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: co.nees(BARE, FLEET), "this method claims none"),
        (lambda: replace(TRACK, x=np.nan * TRACK.x), "not finite in run 0 at step 0"),
        (lambda: co.Kalman()(replace(RECORDING, gnss=np.nan * RECORDING.gnss), [0]), "has no fix at step 0"),
        (lambda: replace(TRACK, egos=(-1, -2)), r"egos\[0\] = -1: must be >= 0"),
        (lambda: replace(TRACK, egos=(0, 9)), "egos = 9: must be an index in 0..3"),
        (lambda: replace(TRACK, t=np.where(TRACK.t > 0.3, np.nan, TRACK.t)), r"t\[4\] = nan: must be finite"),
        (lambda: replace(TRACK, t=TRACK.t[::-1]), r"t\[1\] = 0.4: must increase"),
        (lambda: co.NoiseModel("m"), "process_std = None: must be given"),
        (lambda: of_track(TRACK, OTHER, co.Kalman().message), "ids and times differ from those that were recorded"),
        (lambda: of_track(TRACK, RECORDING.of_runs([0, 0]), co.Kalman().message), "track = 1 runs: must have 2"),
        (lambda: fix_innovations(TRACK, OTHER), "ids and times differ from those that were recorded"),
    ],
)
def test_what_cannot_be_computed_says_why(call: Callable[[], object], words: str) -> None:
    with refused(words):
        call()


def test_a_noun_keeps_no_array_that_its_owner_can_change() -> None:
    whole = np.arange(6) / 10
    part = whole.view()
    part.flags.writeable = False
    fleet = replace(FLEET, t=part)
    whole[3] = 99.0
    assert fleet.t[3] == 0.3


def swept(make: Callable[..., object], given: dict[str, Any], wrong: tuple[Any, ...] = ALL) -> None:
    """Each argument once with each wrong value, the others as given."""
    for name in given:
        for value in wrong:
            call = lambda name=name, value=value: make(**{**given, name: value})  # noqa: E731
            ours(call, f"{name}={shown(value, 40)}")


def init(instance: Any) -> dict[str, Any]:
    """The arguments that a dataclass was made with."""
    return {field.name: getattr(instance, field.name) for field in fields(instance) if field.init}


@pytest.mark.parametrize(
    "noun", [SENSORS, CHANNEL, FLEET, RECORDING, TRACK, RECORDING.links], ids=lambda n: type(n).__name__
)
def test_no_noun_takes_what_it_cannot_hold(noun: Any) -> None:
    swept(type(noun), init(noun))


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.__name__)
def test_methods_refuse_options_and_recordings_of_the_wrong_kind(method: Any) -> None:
    """What a method accepts when it is made, it can run with."""
    for name in init(method()):
        for value in FEW:
            ours(lambda name=name, value=value: method(**{name: value})(RECORDING, [0]), f"{name}={value!r:.40}")
    for value in WRONG:
        ours(lambda value=value: method()(RECORDING, value), f"egos={value!r:.40}")
    for value in (None, FLEET, "town10", []):
        with refused(r"must be a Recording|recording"):
            method()(value, [0])


STREAMS: dict[str, Callable[..., Any]] = {
    "kalman": co.Kalman("identity").start,
    "joint": lambda *start, **more: co.StarStream(co.JointFilter("identity"), *start, **more),
    "adaptive": co.AdaptiveKalman().start,
}


@pytest.mark.parametrize("kind", STREAMS)
def test_a_stream_refuses_what_is_no_measurement(kind: str) -> None:
    start = STREAMS[kind]
    named = inspect.signature(co.StarStream if kind == "joint" else start).parameters
    swept(start, dict.fromkeys(name for name in named if name != "filter"))
    given: dict[str, Any] = {"gnss": [0.0, 0.0, 0.0], "velocity": [1.0, 0.0, 0.0], "dt": 0.1, "fix_age": 0.0}
    if kind == "joint":
        given["neighbours"] = ()
    swept(lambda **step: start().step(**step), given)
    stream = start()
    before = stream.step([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0.1)[0]
    with refused("velocity"):
        stream.step([0.0, 0.0, 0.0], "fast", 0.1)
    assert np.array_equal(start().step([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0.1)[0], before)


def test_functions_refuse_arguments_of_the_wrong_kind() -> None:
    swept(co.observe, {"fleet": FLEET, "sensors": SENSORS, "v2x": CHANNEL, "runs": 1, "seed": 0, "observers": [0]})
    swept(FLEET.between, {"start": 0, "stop": 3})
    relative = {
        "id": "b",
        "relative": [9.0, 0.1, 1.57],
        "gnss": [0.0, 0.0, 0.0],
        "velocity": [0.0, 0.0, 0.0],
        "age": 0.0,
    }
    swept(co.RelativeMeasurement, relative)
    swept(co.Message, {"name": "m", "numbers": 6})
    swept(co.NoiseModel, {"name": "n", "sensors": SENSORS, "gnss_std": (1, 1, 1), "fleet": None})
    for metric in (co.rt_le, co.max_error, co.nees):
        swept(metric, {"track": TRACK, "fleet": FLEET})
    swept(co.posterior_bound, {"fleet": FLEET, "sensors": SENSORS, "ego": 0, "smoothing": False})
    swept(co.fleet_bound, {"fleet": FLEET, "sensors": SENSORS, "v2x": CHANNEL})
    swept(co.pose_bound, {"fleet": FLEET, "sensors": co.Sensors(heading_std=0.1), "v2x": CHANNEL})
    swept(co.OwnMeasurement, {"velocity": [9.0, 0.0, 0.0], "yaw_rate": 0.1, "gnss": [0.0, 0.0, 0.0], "heading": 0.1})
    swept(co.LandmarkMeasurement, {"relative": [9.0, 0.1, 1.57], "place": [0.0, 0.0, 0.0]})
    swept(co.bound_rt_le, {"cov": np.eye(3)[None]})
    swept(co.paired_difference, {"a": [1.0, 2.0], "b": [2.0, 4.0]})
    swept(co.break_even, {"training": None, "online": None})
    swept(RECORDING.between, {"start": 0, "stop": 3})
    swept(RECORDING.neighbours, {"ego": 0})
    swept(RECORDING.links.of, {"observer": 0})


PROBLEM = co.Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)


def test_solvers_refuse_arguments_of_the_wrong_kind() -> None:
    whole = PROBLEM.add("range", ("a", "b"), 10.0, std=1.0)
    solution = co.solve(whole)
    swept(co.solve, {"problem": whole, "backend": "gauss-newton", "throw": True})
    swept(optimize.solve_gnc, {"problem": whole, "candidates": [0], "loss": "truncated", "threshold": 0.99})
    swept(optimize.joint_covariance, {"problem": whole, "solution": solution, "nodes": ["a", "b"]})
    swept(optimize.loop_closures, {"problem": whole})
    swept(co.Loss, {"name": "huber", "scale": 1.0})
    swept(solution.__getitem__, {"point": "a"})
    swept(co.pose, {"position": np.zeros((4, 3)), "turn": np.zeros((4, 3))})
    swept(co.pose, {"position": np.zeros((4, 2)), "turn": 0.1})
    swept(co.Problem, {"names": ("a",), "x0": np.zeros((1, 3)), "poses": (), "fixed": (), "dimension": 3})
    swept(PROBLEM.add, {"kind": "range", "nodes": ("a", "b"), "z": 9.0, "std": 1.0, "loss": None})
    swept(PROBLEM.constrain, {"kind": "range", "nodes": ("a", "b"), "lower": 1.0, "upper": 9.0})
    window = {"recording": RECORDING, "step": 2, "ego": 0, "length": 2, "run": 0, "noise": None}
    swept(co.Problem.from_window, window)
    swept(co.Problem.from_steps, {"steps": [], "sensors": SENSORS, "names": None})
    named = {"name": "misused", "arity": 1, "components": ("coordinate",), "frame": "world", "linear": False}
    swept(lambda **given: optimize.measurement(**given), {**named, "constants": 0})


def test_noise_bodies_and_starts_refuse_what_is_no_array_of_theirs() -> None:
    wrong, body = (*ALL, RECORDING, TRACK), co.observe(FLEET, co.Sensors(), CHANNEL, frame="body")
    swept(co.NoiseModel.nominal, {"sensors": SENSORS}, wrong)
    swept(co.NoiseModel.oracle, {"sensors": SENSORS, "fleet": FLEET}, wrong)
    swept(co.NoiseModel.fitted, {"recording": RECORDING, "fleet": FLEET}, (*wrong, FLEET.between(0, 3)))
    swept(co.Body, {"yaw_rate": np.zeros((1, 2, 1)), "heading": np.zeros((1, 2, 1))}, wrong)
    swept(lambda begin: co.PoseFilter(begin=begin)(body, [0]), {"begin": None}, wrong)
    whole = PROBLEM.add("range", ("a", "b"), 10.0, std=1.0)
    with refused("nodes = 10000 nodes: must name each of 2 nodes once"):
        optimize.joint_covariance(whole, co.solve(whole), "a" * 10_000)


def test_training_refuses_arguments_of_the_wrong_kind() -> None:
    learned = pytest.importorskip("coopoc.learned", exc_type=ImportError)
    wrong = (*ALL, RECORDING)
    drive = co.load_fleet("town10").between(0, 24).select([0])
    given = {"fleet": drive, "sensors": None, "seed": 0, "piece": 10, "split": 0.5}
    swept(lambda fleet, **options: learned.clients(fleet, **options), given, wrong)


def test_files_and_studies_refuse_arguments_of_the_wrong_kind(tmp_path: Path) -> None:
    for read in (
        co.read_graph,
        load_graph,
        read_g2o,
        read_pyfg,
        co.load_fleet,
        co.load_recording,
        co.read_log,
    ):
        swept(lambda path, read=read: read(path), {"path": "nowhere.pyfg"})
    for value in (None, 1, [], b"x"):
        with refused("study"):
            co.run_study(value, tmp_path, progress=False)  # type: ignore[arg-type]
        with refused("path"):
            co.run_study("neighbours", value, progress=False)  # type: ignore[arg-type]


def test_a_duration_and_a_mask_are_no_numbers() -> None:
    with refused(r"dt = np\.timedelta64"):  # 300 ms are no 300 s
        co.Kalman("identity").start().step([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], np.timedelta64(300, "ms"))  # type: ignore[arg-type]
    with refused("a = dtype object"):  # numbers behind a mask are none
        co.paired_difference(np.ma.masked_array([1.0, 2.0], [True, False]), np.ones(2))


def test_training_refuses_values_from_elsewhere() -> None:
    learned = pytest.importorskip("coopoc.learned")
    drive = co.load_fleet("town10").between(0, 44).select([0])
    (client,) = learned.clients(drive, piece=10)
    schedule, wrong = learned.Schedule(epochs=1, checks=1), (*WRONG, *HOSTILE)
    for made in (schedule, learned.Participation(), learned.Setting(), learned.Recipe("okf"), client):
        swept(type(made), init(made), wrong)
    swept(learned.Segments, init(client.training), HOSTILE)
    swept(learned.OptimisedKF, {"process_std": (1, 1, 1), "velocity_ratio": (1, 1, 1), "gnss_std": (1, 1, 1)}, wrong)
    few = (None, -1, 1.5, "x", [], *HOSTILE)
    net = learned.NoiseParameters()
    fit = {"model": net, "training": client.training, "validation": client.validation, "schedule": schedule, "seed": 0}
    swept(learned.fit, {**fit, "progress": None, "long": None}, few)
    federation = {"model": "okf", "clients": [client], "rounds": 1, "local_epochs": 1, "schedule": schedule, "seed": 0}
    more = dict.fromkeys(("progress", "participation"))
    swept(learned.federate, {**federation, **more, "aggregate": "mean"}, few)
    swept(learned.ledger, {"federation": learned.federate(**federation), "overhead": 0}, wrong)
    swept(learned.LearnedGain, {"model": learned.GainNet(), "name": "n", "x0": None}, wrong)
    with refused(r"epochs = 1\.5: must be a whole number"):
        learned.Schedule(epochs=1.5)


@pytest.mark.parametrize("path", [np.array(3), pd.NA, None, "", "a" * 300, "a/" * 3000, "a\0b", "\ud800", Foreign()])
def test_paths_that_no_file_system_holds_are_refused(tmp_path: Path, path: Any) -> None:
    learned = pytest.importorskip("coopoc.learned")
    checkpoint = learned.Checkpoint(learned.NoiseParameters(), {})
    reads = (co.read_graph, co.load_fleet, co.load_recording, co.read_log, co.Results.load, learned.load, views)
    others = (lambda p: learned.save(p, checkpoint), lambda p: merge([p], tmp_path), lambda p: report([p], tmp_path))
    for call in (*reads, learned.load_method, Reference.load, *others):
        with pytest.raises(co.InputError):
            call(path)
