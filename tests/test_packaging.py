"""Where users look for the package: workflows, image, conda recipe and pins say the same as pyproject.toml."""

import importlib.metadata
import json
import re
import tomllib

import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from shell import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PINNED = re.compile(r"uses: ([\w./-]+)@([0-9a-f]{40}) # v\d+\.\d+\.\d+$")


def pins():
    lines = (ROOT / "constraints.txt").read_text().splitlines()[1:]
    return {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}


def closure(names):
    """Distributions that these need on this machine, and they themselves."""
    found = set[str]()
    while names:
        if (name := canonicalize_name(names.pop())) not in found:
            found.add(name)
            needs = map(Requirement, importlib.metadata.requires(name) or ())
            names += [need.name for need in needs if need.marker is None or need.marker.evaluate({"extra": ""})]
    return found


def test_every_action_is_pinned_by_its_commit_and_one_commit_each():
    used = [line.strip(" -") for path in WORKFLOWS for line in path.read_text().splitlines() if "uses:" in line]
    found = {match.groups() for line in used if (match := PINNED.fullmatch(line))}
    assert len(used) == sum(bool(PINNED.fullmatch(line)) for line in used) > 4
    assert len({action for action, _ in found}) == len(found)


def test_only_the_job_that_publishes_may_ask_for_a_token():
    release = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    jobs = release["jobs"]
    assert release[True] == {"push": {"tags": ["v[0-9]+.[0-9]+.[0-9]+"]}}  # YAML 1.1 reads "on" as true
    assert release["permissions"] == {}
    assert {name: job["permissions"] for name, job in jobs.items()} == {
        "build": {"contents": "read"},
        "publish": {"id-token": "write"},
    }
    assert jobs["publish"]["environment"]["name"] == "pypi"
    assert jobs["publish"]["needs"] == "build"
    assert any(step.get("run", "").startswith("make release") for step in jobs["build"]["steps"])
    assert "secrets." not in (ROOT / ".github" / "workflows" / "release.yml").read_text()


def test_every_package_that_is_installed_is_pinned():
    missing = closure([Requirement(text).name for text in PROJECT["dependencies"]]) - set(pins())
    assert missing == set()
    assert {"pip", "uv", "setuptools", "wheel"} <= set(pins())
    assert (ROOT / "Makefile").read_text().count("\t$(PIP) pip\n") == 1


def test_the_conda_recipe_needs_what_the_wheel_needs():
    recipe = yaml.safe_load((ROOT / ".ci" / "conda" / "recipe.yaml").read_text())
    python, *run = recipe["requirements"]["run"]
    assert python == "python >=${{ python_min }}"
    wheel = {re.sub(r"(?<=\w)(?=[<>])", " ", text, count=1) for text in PROJECT["dependencies"]}
    assert {text.replace("matplotlib-base", "matplotlib") for text in run} == wheel
    assert recipe["context"]["version"] == PROJECT["version"]
    assert recipe["build"]["python"]["entry_points"] == [f"{k} = {v}" for k, v in PROJECT["scripts"].items()]
    assert recipe["about"]["license_file"] == PROJECT["license-files"]


def test_the_image_and_the_editor_run_targets_that_are_there():
    image = (ROOT / "Dockerfile").read_text()
    editor = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    bases = re.findall(r"^FROM (\S+) AS (\w+)", image, re.MULTILINE)
    assert re.fullmatch(r"\S+:3\.1[123]-\S+@sha256:[0-9a-f]{64}", bases[0][0])
    assert editor["build"]["target"] in {stage for _, stage in bases}
    assert f"--create-home {editor['remoteUser']} " in image
    assert (ROOT / ".devcontainer" / editor["build"]["dockerfile"]).resolve() == ROOT / "Dockerfile"
    made = (ROOT / "Makefile").read_text().replace("$(VENV)", ".venv")
    wanted = set(re.findall(r"\bmake ([\w./-]+)", f"{image} {editor['postCreateCommand']}"))
    assert {"paper", "test", ".venv/.ready-dev"} >= wanted >= {"paper", ".venv/.ready-dev"}
    for target in wanted:
        assert re.search(rf"^{re.escape(target)}:", made, re.MULTILINE), target


def test_the_tag_of_a_release_is_looked_up_as_it_stands():
    """The workflow searches this line for the version of the tag."""
    assert (ROOT / "pyproject.toml").read_text().splitlines().count(f'version = "{PROJECT["version"]}"') == 1
