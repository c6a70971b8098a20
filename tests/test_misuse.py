"""Wrong calls of the public functions: each is refused with an error of ours that names the field, or has an answer."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from numpy import eye, full, nan, ones, zeros
from random_graphs import AB, PAIR

import coopoc as co
from coopoc import optimize
from coopoc.errors import shown
from coopoc.evaluate.ledger import of_track
from coopoc.evaluate.metrics import fix_innovations
from coopoc.formats import load_graph, read_g2o, read_pyfg
from coopoc.methods.track import follow as followed
from coopoc.study.publish import views
from coopoc.study.reference import Reference
from coopoc.study.report import report
from coopoc.world.body_frames import true_heading
from coopoc.world.sensors import ANGULAR

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
    ones((2, 2)),
    full(3, nan),
)
"""Values of the wrong kind, size or range; some are right for some fields."""
RAGGED: tuple[Any, ...] = ([[1], [2, 3]], np.datetime64("2024-01-01"), np.array([1, 2], object), 1 + 2j, [10**400] * 4)
"""Values that NumPy cannot turn into numbers, or whose comparisons are no truth values."""


class Foreign:
    """An object of a library of which nothing is known: it is no array, and has not even a text."""

    def __array__(self, *_given, **_options: Any):
        raise RuntimeError("no array")

    def __repr__(self):
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
FLEET = co.load_fleet("town10").between(0, 6).select([0, 1, 2, 3])
SENSORS, CHANNEL = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=3)
RECORDING = co.observe(FLEET, SENSORS, CHANNEL)
TRACK = co.Kalman()(RECORDING, [0, 1])


def ours(call, what):
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
        (lambda: replace(TRACK, x=nan * TRACK.x), "not finite in run 0 at step 0"),
        (lambda: co.Kalman()(replace(RECORDING, gnss=nan * RECORDING.gnss), [0]), "has no fix at step 0"),
        (lambda: load_graph("."), r"path = \.: must end in"),
        (lambda: followed("kalman", RECORDING, [0]), "method = 'kalman': must be a Method"),
        (lambda: replace(TRACK, egos=(-1, -2)), r"egos\[0\] = -1: must be >= 0"),
        (lambda: replace(TRACK, egos=(0, 9)), "egos = 9: must be an index in 0..3"),
        (lambda: replace(TRACK, t=np.where(TRACK.t > 0.3, nan, TRACK.t)), r"t\[4\] = nan: must be finite and increase"),
        (lambda: replace(TRACK, t=TRACK.t[::-1]), r"t\[1\] = 0.4: must be finite and increase"),
        (lambda: co.NoiseModel("m"), "process_std = None: must be given"),
        (lambda: co.NoiseModel("m", SENSORS, gnss_std=(0, 1, 1)), r"gnss_std\[0\] = 0.0: must be positive"),
        (lambda: of_track(TRACK, OTHER, co.Kalman().message), "ids and times differ from those that were recorded"),
        (lambda: of_track(TRACK, RECORDING.of_runs([0, 0]), co.Kalman().message), "track = 1 runs: must have 2"),
        (lambda: fix_innovations(TRACK, OTHER), "ids and times differ from those that were recorded"),
        (lambda: co.Kalman()(RECORDING, iter([0])), "egos = .*must be a sequence"),
        (lambda: co.Kalman()(RECORDING, {*RECORDING.ids}), "egos = .*must be a sequence"),
        (lambda: co.observe(FLEET, SENSORS, CHANNEL, runs=10**9), r"runs = 1000000000: must be in 1..\d"),
        (lambda: co.bound_rt_le(-eye(3)[None]), r"trace of cov\[0\] = -3.0: must be >= 0"),
        (lambda: co.write_tum("x.tum", [0, 1], eye(2, 3), [90, 91]), r"heading\[0\] = 90.0: must be in rad"),
        (lambda: co.Kalman("identity").start().step(zeros(3), zeros(3), 1e9), r"> 1 ns and at most 1e\+08"),
    ],
)
def test_what_cannot_be_computed_says_why(call, words):
    with refused(words):
        call()


def test_a_noun_keeps_no_array_that_its_owner_can_change():
    whole = np.arange(6) / 10
    part = whole.view()
    part.flags.writeable = False
    fleet = replace(FLEET, t=part)
    whole[3] = 99.0
    assert fleet.t[3] == 0.3
    assert not RECORDING.links.of(0).flags.writeable
    graph = replace(PAIR, x0=eye(2, 3)).constrain("range", AB, lower=1.0)
    graphs = (graph, *graph.factors, *graph.constraints)
    for noun in (FLEET, RECORDING, TRACK, of_track(TRACK, RECORDING, co.Kalman().message), *graphs):
        for copied in (copy.deepcopy(noun), pickle.loads(pickle.dumps(noun))):
            for part in (copied, getattr(copied, "links", copied)):
                assert not any(a.flags.writeable for a in vars(part).values() if isinstance(a, np.ndarray) and a.size)


def swept(make, given, wrong=ALL):
    """Each argument once with each wrong value, the others as given."""
    for name in given:
        for value in wrong:
            call = lambda name=name, value=value: make(**{**given, name: value})  # noqa: E731
            ours(call, f"{name}={shown(value, 40)}")


def init(instance):
    """The arguments that a dataclass was made with; priors are checked one by one."""
    return {f.name: getattr(instance, f.name) for f in fields(instance) if f.init and f.name != "priors"}


TOWN = co.load_fleet("town10").between(0, 40).select([8, 9, 10, 11])
TOWN = replace(TOWN, heading=true_heading(TOWN))
SEEN = co.observe(TOWN, SENSORS, CHANNEL, runs=2)
BODY = co.observe(TOWN, replace(SENSORS, heading_std=0.05), CHANNEL, runs=2, frame="body")
OWN, POSES = co.Kalman()(SEEN, [0, 1]), co.PoseFilter("solo")(BODY, [0])
BYTES = co.Ledger(("a",), [9.0], ones((2, 1, 1)), ones((2, 1, 1)))
NOISE = replace(SENSORS, **dict.fromkeys(ANGULAR, 0.07))


def follow(kind, recording, egos, **options: Any):
    return kind(**options)(recording, egos)


def own(gate, **measured: Any):
    return co.PoseFilter("solo", assumed=SENSORS, gate=gate).start(0.1, zeros(4)).step(co.OwnMeasurement(**measured))


def solo(x0, interval, history, **step: Any):
    return co.Kalman("identity").start(x0, interval=interval, history=history).step(**step)


def star(gnss, velocity, dt, fix_age, **neighbour: Any):
    stream = co.StarStream(co.CooperativeFilter(co.NoiseModel.nominal(SENSORS)), [0.0, 0.0, 0.0])
    return stream.step(gnss, velocity, dt, fix_age, [co.RelativeMeasurement(gnss=gnss, velocity=velocity, **neighbour)])


def least_squares(nodes, z, std, x0):
    return co.solve(replace(PAIR, x0=x0).add("range", nodes, z, std=std)).x


FOLLOWED: dict[str, Any] = {"recording": SEEN, "egos": [0, 1]}
MEASURED: dict[str, Any] = {"gnss": [0.0, 0.0, 0.0], "velocity": [9.0, 0.0, 0.0]}
MESSAGE: dict[str, Any] = {"id": "b", "relative": [9.0, 0.7, 1.57], "age": 0.1, **MEASURED}
MESSAGE |= {"variance": [1.0, 1.0, 1.0], "odometer": [0.0, 1.0, 2.0]}


def drawn(plot, **given: Any):
    plot(**given)


BOUND: dict[str, Any] = {"fleet": TOWN, "sensors": NOISE, "v2x": CHANNEL}
PUBLIC: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    **{
        kind.__name__: (partial(follow, kind), {**FOLLOWED, **init(kind())})
        for kind in (
            co.GNSS,
            co.Kalman,
            co.JointFilter,
            co.LKFSA,
            co.MSMV,
            co.BatchSmoother,
            co.CovarianceIntersection,
            co.CooperativeFilter,
        )
    },
    **{
        type(noun).__name__: (type(noun), init(noun))
        for noun in (
            SEEN,
            BODY.body,
            TOWN,
            OWN,
            SEEN.links,
            BYTES,
            NOISE,
            CHANNEL,
            co.Fault(0.1, (1.0, 2.0)),
            co.Outliers(),
        )
    },
    **{score.__name__: (score, {"track": OWN, "fleet": TOWN}) for score in (co.rt_le, co.max_error, co.nees)},
    **{score.__name__: (score, {"track": POSES, "fleet": TOWN}) for score in (co.heading_error, co.pose_nees)},
    **{bound.__name__: (bound, BOUND) for bound in (co.fleet_bound, co.pose_bound)},
    "posterior_bound": (co.posterior_bound, {**BOUND, "ego": 0, "smoothing": False}),
    "bound_rt_le": (co.bound_rt_le, {"cov": np.tile(eye(3), (4, 1, 1))}),
    "observe": (co.observe, {**BOUND, "runs": 1, "seed": 0, "observers": [0]}),
    "in_world": (co.in_world, {"recording": BODY}),
    "stars": (lambda **given: list(co.stars(**given)), {"recording": SEEN, "ego": 0, "noise_model": "nominal"}),
    "paired_difference": (co.paired_difference, {"a": ones((3, 2)), "b": eye(3)[:, :2]}),
    "NoiseModel": (
        co.NoiseModel,
        {"name": "n", "sensors": SENSORS, "process_std": (1, 1, 1), "gnss_std": (1, 1, 1), "compass": (0.1, 0.1)},
    ),
    "NoiseModel.nominal": (co.NoiseModel.nominal, {"sensors": SENSORS}),
    "NoiseModel.oracle": (co.NoiseModel.oracle, {"sensors": SENSORS, "fleet": FLEET}),
    "NoiseModel.fitted": (co.NoiseModel.fitted, {"recording": RECORDING, "fleet": FLEET}),
    "Kalman.start": (
        solo,
        {**MEASURED, "x0": [0.0, 0.0, 0.0], "interval": 0.1, "history": 10.0, "dt": 0.1, "fix_age": 0.0},
    ),
    "PoseFilter": (
        partial(follow, co.PoseFilter),
        {"recording": BODY, "egos": [0], "begin": full((4, 4), 0.7), "spread": full(4, 0.7), "gate": 5.0},
    ),
    "pose_start": (co.pose_start, {"recording": BODY, "seconds": 3.0, "gate": 5.0}),
    "OwnMeasurement": (own, {**MEASURED, "yaw_rate": 0.7, "heading": 0.7, "gate": 5.0}),
    "LandmarkMeasurement": (co.LandmarkMeasurement, {"relative": [9.0, 0.7, 1.57], "position": [1.0, 2.0, 3.0]}),
    "RelativeMeasurement": (co.RelativeMeasurement, MESSAGE),
    "StarStream": (star, {**MESSAGE, "dt": 0.1, "fix_age": 0.0}),
    "Message": (co.Message, {"name": "m", "numbers": 6, "rounds": 1, "per_neighbour": 0}),
    "Message.size": (co.GNSS().message.size, {"overhead": 0, "neighbours": 3}),
    "Recording.stretches": (SEEN.stretches, {"vehicle": 0, "shortest": 2, "fixed": True}),
    "Recording.columns": (SEEN.columns, {"egos": [0], "fixed": True}),
    "Sensors.motion_noise": (NOISE.motion_noise, {"interval": 0.1}),
    "NoiseModel.process_variance": (co.NoiseModel.nominal(NOISE).process_variance, {"recording": SEEN}),
    "NoiseModel.fix_scale": (co.NoiseModel.nominal(NOISE).fix_scale, {"recording": SEEN}),
    "Loss": (co.Loss, {"name": "huber", "scale": 1.0}),
    "Problem": (least_squares, {"nodes": AB, "z": 10.0, "std": 1.0, "x0": np.array([[0.0, 0, 0], [9, 0, 1]])}),
    "solve": (lambda **given: co.solve(**given).x, {"problem": PAIR, "backend": "gauss-newton"}),
    "incremental": (lambda **given: co.incremental(**given)[0], {"problem": PAIR, "params": None}),
    "pose": (co.pose, {"position": zeros((4, 2)), "turn": full(4, 0.7)}),
    "plot_recording": (partial(drawn, co.plot_recording), {"recording": SEEN, "run": 0, "step": 1}),
    "plot_track": (partial(drawn, co.plot_track), {"track": OWN, "fleet": TOWN, "every": 9}),
    "plot_solution": (partial(drawn, co.plot_solution), {"solution": co.solve(PAIR), "problem": PAIR}),
}
"""Every public callable, and arguments that are right."""
ELSEWHERE = {
    "Backend, Method": "protocols",
    "InputError, MissingLibraryError": "what is raised",
    "Constraint, Factor, Solution, backends": "made by Problem and solve",
    "Results, Study, run_study": "settings: test_study_run",
    "fetch, load_fleet, read_log, read_graph, write_tum": "paths: test_data_readers",
}
ALLOWED = {
    "Recording relative nan": "not measured",
    "Body yaw_rate nan": "absent",
    "Body heading nan": "no compass",
    "Fleet heading nan": "unknown",
    "LandmarkMeasurement relative nan": "not measured",
    "RelativeMeasurement relative nan": "not measured",
    "V2X radius inf": "no limit",
    "Body yaw_rate degrees": "noted by its Recording",
    "observe fleet ids": "draws belong to names",
    "pose position nan": "unknown",
    "pose position inf": "refused by Problem",
    "Problem z 1e+200": "NumPy warns of the overflow",
}
"""What is accepted although it looks wrong -> why."""
LABELS = ("name", "source", "licence", "id", "notes")
ANGLES = (*ANGULAR, "heading", "yaw_rate", "relative", "begin", "turn", "compass")


def first(value, wrong):
    """The numbers with one wrong one, or the number itself."""
    array = np.array(value, float)
    array.flat[0] = wrong
    return array if array.ndim else wrong


def others(value):
    """The same of other vehicles, or a name that is none."""
    ids = tuple(f"other {name}" for name in getattr(value, "ids", ()))
    return replace(value, ids=ids) if ids else "nobody"


CHANGES: dict[str, Callable[[Any], Any]] = {
    **{str(wrong): partial(first, wrong=wrong) for wrong in (nan, np.inf, -1.0, 1e200, 1e-200)},
    "shape": lambda value: np.array(value)[None, None],
    "dtype": lambda value: np.array(value).astype(str),
    "ids": others,
    "degrees": lambda value: np.rad2deg(np.array(value)),
}


def arrays(found):
    if isinstance(found, np.ndarray | float | np.floating):
        return [np.asarray(found, float)]
    parts = found if isinstance(found, list | tuple) else vars(found).values() if hasattr(found, "__dict__") else ()
    return [array for part in parts for array in arrays(part)]


def answered(found, right, change):
    """Whether there is a note, or no number is less finite than it was; of other names and degrees the same numbers."""
    if getattr(found, "notes", ()):
        return True
    ours, theirs = ([a for a in arrays(one) if a.ndim] for one in (found, right))
    if change in ("ids", "degrees"):
        return len(ours) == len(theirs) and all(map(partial(np.array_equal, equal_nan=True), ours, theirs))
    return sum(np.sum(~np.isfinite(a)) for a in arrays(found)) <= sum(np.sum(~np.isfinite(a)) for a in arrays(right))


def test_every_public_name_is_tried():
    assert {*(name.split(".")[0] for name in PUBLIC), *(name for names in ELSEWHERE for name in names.split(", "))} == {
        *co.__all__
    }


@pytest.mark.parametrize("name", PUBLIC)
def test_a_wrong_argument_gives_an_error_of_ours_a_right_number_or_a_note(name):
    call, given = PUBLIC[name]
    right = call(**given)
    for field, value in given.items():
        numeric = np.asarray(value).dtype.kind in "fiu" and np.size(value) and not isinstance(value, bool)
        for change, wrong in CHANGES.items():
            if field in LABELS or not (
                numeric if change not in ("ids", "degrees") else change == "ids" or field in ANGLES
            ):
                continue
            if value is None or f"{name} {field} {change}" in ALLOWED:
                continue
            try:
                found = call(**{**given, field: wrong(value)})
            except (co.InputError, co.MissingLibraryError, optimize.SolveError):
                continue
            assert answered(found, right, change), f"{field}: {change}"
    swept(call, given)


def test_solvers_refuse_arguments_of_the_wrong_kind():
    whole = PAIR.add("range", AB, 10.0, std=1.0)
    solution = co.solve(whole)
    swept(optimize.solve_gnc, {"problem": whole, "candidates": [0], "loss": "truncated", "threshold": 0.99})
    with refused("nodes = 10000 nodes: must name each of 2 nodes once"):
        optimize.joint_covariance(whole, solution, ["a"] * 10_000)
    swept(optimize.joint_covariance, {"problem": whole, "solution": solution, "nodes": ["a", "b"]})
    swept(optimize.loop_closures, {"problem": whole})
    swept(solution.__getitem__, {"point": "a"})
    swept(co.Problem, {"names": ("a",), "x0": zeros((1, 3)), "poses": (), "fixed": (), "dimension": 3})
    swept(PAIR.add, {"kind": "range", "nodes": AB, "z": 9.0, "std": 1.0, "loss": None})
    swept(PAIR.constrain, {"kind": "range", "nodes": AB, "lower": 1.0, "upper": 9.0})
    swept(co.Problem.from_window, {"recording": RECORDING, "step": 2, "ego": 0, "length": 2, "run": 0, "noise": None})
    named = {"name": "misused", "arity": 1, "components": ("coordinate",), "frame": "world", "linear": False}
    swept(lambda **given: optimize.measurement(**given), {**named, "constants": 0})


def test_arrays_of_the_wrong_kind_are_refused():
    """NaN is no error there: absent, not measured."""
    swept(NOISE.velocity_std, {"velocity": ones((4, 3)), "floor": 0.1})
    swept(NOISE.motion_std, {"velocity": ones((1, 4, 2, 3)), "interval": 0.1})
    swept(co.NoiseModel.nominal(NOISE).relative_cov, {"relative": SEEN.relative})
    swept(PAIR.linearise, {"x": eye(2, 3)})
    for law in (co.Loss("huber", 1.0).cost, co.Loss("huber", 1.0).weight):
        swept(law, {"square": 1.0})


def test_files_and_studies_refuse_arguments_of_the_wrong_kind(tmp_path):
    for read in (co.read_graph, load_graph, read_g2o, read_pyfg, co.load_fleet, co.read_log):
        for value in ALL:
            ours(partial(read, value), f"path={shown(value, 40)}")
    for value in (None, 1, [], b"x"):
        with refused("study"):
            co.run_study(value, tmp_path)  # type: ignore[arg-type]
        with refused("path"):
            co.run_study("neighbours", value)  # type: ignore[arg-type]


def test_a_duration_and_a_mask_are_no_numbers():
    with refused(r"dt = np\.timedelta64"):  # 300 ms are no 300 s
        co.Kalman("identity").start().step([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], np.timedelta64(300, "ms"))  # type: ignore[arg-type]
    with refused("a = dtype object"):  # numbers behind a mask are none
        co.paired_difference(np.ma.masked_array([1.0, 2.0], [True, False]), ones(2))


def test_training_refuses_values_from_elsewhere():
    learned = pytest.importorskip("coopoc.learned")
    drive = co.load_fleet("town10").between(0, 44).select([0])
    (client,) = learned.clients(drive, piece=10)
    schedule, wrong = learned.Schedule(epochs=1, checks=1), (*WRONG, *HOSTILE)
    for made in (schedule, learned.Participation(), learned.Setting(), learned.Recipe("okf"), client):
        swept(type(made), init(made), wrong)
    swept(learned.Segments, init(client.training), HOSTILE)
    swept(learned.clients, {"fleet": drive, "sensors": None, "seed": 0, "piece": 10, "split": 0.5}, (*ALL, RECORDING))
    swept(learned.OptimisedKF, {"process_std": (1, 1, 1), "velocity_ratio": (1, 1, 1), "gnss_std": (1, 1, 1)}, wrong)
    few = (None, -1, 1.5, "x", [], *HOSTILE)
    net = learned.NoiseParameters()
    with refused("seed = 'x'"):
        learned.NoiseParameters("x")
    fit = {"model": net, "training": client.training, "validation": client.validation, "schedule": schedule, "seed": 0}
    swept(learned.fit, {**fit, "progress": None, "long": None}, few)
    federation = {"model": "okf", "clients": [client], "rounds": 1, "local_epochs": 1, "schedule": schedule, "seed": 0}
    swept(learned.federate, {**federation, **dict.fromkeys(("progress", "participation")), "aggregate": "mean"}, few)
    swept(learned.ledger, {"federation": learned.federate(**federation), "overhead": 0}, wrong)
    swept(learned.LearnedGain, {"model": learned.GainNet(), "name": "n", "x0": None}, wrong)
    with refused("out = /dev/null: cannot be made"):
        learned.train_all(drive, "/dev/null", recipes=["okf"], seeds=[0], progress=False)
    with refused(r"epochs = 1\.5: must be a whole number"):
        learned.Schedule(epochs=1.5)


@pytest.mark.parametrize("path", [np.array(3), pd.NA, None, "", "a" * 300, "a/" * 3000, "a\0b", "\ud800", Foreign()])
def test_paths_that_no_file_system_holds_are_refused(tmp_path, path):
    (tmp_path / "log").mkdir()
    (tmp_path / "log/\udcf6.csv").write_text("t,vehicle,x,y\n0,a,0,0\n1,a,1,0\n")
    with refused("must have a name in UTF-8"):
        co.read_log(tmp_path / "log")
    learned = pytest.importorskip("coopoc.learned")
    checkpoint = learned.Checkpoint(learned.NoiseParameters(), {})
    reads = (co.read_graph, co.load_fleet, co.read_log, co.Results.load, learned.load, views)
    others = (lambda p: learned.save(p, checkpoint), lambda p: report([p], tmp_path))
    for call in (*reads, learned.load_method, Reference.load, *others):
        with pytest.raises(co.InputError):
            call(path)
