"""Our server of UM-Bridge with the package's client, and our client with the package's server, which may die."""

import pickle
import signal
import socket
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    Posterior,
    Prior,
    SimulationCache,
    SimulationFailed,
    TruncatedNormal,
    UMBridgeModel,
)
from fe_likelihoods.adapters import serve
from fe_likelihoods.simulation.failure_reasons import TransientReason, UnusableModel
from samplers import SMCSampler

from .problem import CRITICAL, make_posterior, starts_of
from .served import WRONG, Process, free_port, line

umbridge = pytest.importorskip("umbridge", reason="UMBRIDGE IS NOT INSTALLED: pip install umbridge")
requests = pytest.importorskip("requests")

NAMES, CHANNELS = ("offset", "slope"), [Channel(name, "displacement", "mm") for name in ("top", "base")]
THETAS = np.random.default_rng(3).uniform(0.0, 2.0, (8, 2))
DATA = Measurements(CHANNELS, 0.1, line([1.0, 0.5]) + 0.1 * np.random.default_rng(4).normal(size=(2, 20)))


@pytest.fixture(scope="module")
def ours():
    """Our server in a process of its own, which Ctrl-C ends."""
    with Process("ours") as server:
        yield server
        server.process.send_signal(signal.SIGINT)
        assert "done" in server.process.communicate(timeout=60)[0]


@pytest.fixture(scope="module")
def package():
    """The package's own server."""
    with Process("package") as server:
        yield server


def remote(server, name="forward", **options):
    return UMBridgeModel(server.url, name, NAMES, CHANNELS, 0.1, **({"retries": 1, "retry_wait": 0.01} | options))


def model(function=line, names=NAMES):
    return FunctionModel(function, names, CHANNELS, 0.1, 20, version="line")


def test_posterior_is_served_with_all_digits(ours):
    assert umbridge.supported_models(ours.url) == ["line", "posterior"]
    client, posterior = umbridge.HTTPModel(ours.url, "posterior"), make_posterior()
    assert (client.get_input_sizes(), client.get_output_sizes()) == ([4], [1])
    for point in starts_of(posterior, 3, 1):
        for density in ("log_prob", "log_prior", "log_likelihood"):
            expected = getattr(posterior, density)(point)
            assert client([point.tolist()], {"density": density}) == [[expected]], density
        assert client([point.tolist()]) == [[posterior(point)]]
        for density in ("log_prob", "log_likelihood"):
            expected = 2.0 * getattr(posterior, f"grad_{density}")(point)
            assert client.gradient(0, 0, [point.tolist()], [2.0], {"density": density}) == expected.tolist()
    for point in ([1.0, 9.0, 0.5, 0.01], [1.0, CRITICAL + 0.1, 0.5, 0.01]):  # outside the prior, and failed
        assert posterior(np.array(point)) == -np.inf and client([point]) == [[-1e100]]
    assert client.supports_gradient() and not (client.supports_apply_jacobian() or client.supports_apply_hessian())


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ('{"name": "posterior", "input": [[1.0, 2.0]]}', "Expected 4 but got 2"),
        ('{"name": "posterior", "input": [1, 1, 1, 1]}', "Number of input parameters"),
        ('{"name": "posterior", "input": [["1", "1", "1", "1"]]}', "expected finite numbers"),
        ('{"name": "posterior", "input": [[NaN, 1, 1, 1]]}', "expected finite numbers"),
        ('{"name": "posterior", "input": [[1, 1, 1, 1]], "config": {"density": "ndim"}}', "expected a config"),
        ('{"name": "line", "input": [[1, 1]], "config": {"level": 1}}', "expected a config"),
        ('{"name": "column", "input": [[1, 1]]}', "Model column not found"),
        ('{"input": [[1, 1]]}', "name"),
        ("{", "Expecting property name"),
    ],
)
def test_wrong_request_is_answered_with_a_reason(ours, request_, message):
    answer = requests.post(f"{ours.url}/Evaluate", request_, timeout=60)
    assert answer.status_code in (400, 500) and message in answer.json()["error"]["message"]


@pytest.mark.skipif(sys.platform != "linux", reason="ONLY LINUX HAS A SECOND ADDRESS WITHOUT A NETWORK, 127.0.0.2")
def test_server_accepts_connections_of_this_machine_alone_unless_told():
    def connects(host):
        with serve(model(), port=0, block=False, **host) as server, socket.socket() as client:
            port = int(server.url.rpartition(":")[2])
            assert client.connect_ex(("127.0.0.1", port)) == 0
            with socket.socket() as other:
                return other.connect_ex(("127.0.0.2", port)) == 0

    assert not connects({})
    assert connects({"host": "0.0.0.0"})


def test_served_model_has_the_same_bits_and_failures_keep_their_kind(ours):
    client = remote(ours, "line")
    for theta in [*THETAS, [1e-300, 1.0 / 3.0], [-0.0, 2.0**60]]:
        assert client.simulate(theta).tobytes() == line(theta).tobytes()
    for offset, reason, transient in (
        (3.5, r"^collapse at the top$", False),
        (2.5, "^no licence was free$", True),
        (np.nan, "not finite", False),
    ):
        with pytest.raises(SimulationFailed, match=reason) as failed:
            client.simulate([offset, 1.0])
        assert isinstance(failed.value.reason, TransientReason) == transient


def test_vectors_configuration_and_fingerprint(package, ours):
    plain, doubled = remote(package), remote(package, config={"factor": 2.0})
    copy = pickle.loads(pickle.dumps(doubled))
    assert (plain.input_sizes, plain.n_steps) == ([1, 1], 20)
    np.testing.assert_array_equal(plain.simulate([0.5, 1.0]), line([0.5, 1.0]))
    np.testing.assert_array_equal(copy.simulate([0.5, 1.0]), 2.0 * line([0.5, 1.0]))
    sums = remote(package, output=lambda vectors: [[sum(vectors[0])], [sum(vectors[1])]], n_steps=1)
    np.testing.assert_allclose(sums.simulate([0.5, 1.0])[:, 0], line([0.5, 1.0]).sum(axis=1), rtol=1e-14)
    others = [plain, doubled, sums, remote(package, version="2"), remote(ours, "line")]
    assert len({other.fingerprint for other in others}) == 5 and copy.fingerprint == doubled.fingerprint


@pytest.mark.parametrize(("slope", "text"), [*enumerate(WRONG, 90), (1.0, "an exception of the model")])
def test_error_or_malformed_answer_is_a_failure_of_the_model(package, slope, text):
    reasons = {90: "HTTP 200: nan", 91: "HTTP 200: -?inf", 1.0: "HTTP 500: Internal"}
    for options in ({}, {"output": lambda vectors: np.array(vectors)[:, :19], "n_steps": 19}):
        with pytest.raises(SimulationFailed, match=reasons.get(slope, "expected numbers")) as failed:
            remote(package, **options).simulate([3.5 if slope == 1.0 else 1.0, slope])
        assert not isinstance(failed.value.reason, TransientReason)


def test_load_balancer_without_a_free_server_is_asked_again_and_other_pages_are_no_failure_of_the_model(
    package, monkeypatch
):
    client, post, answers = remote(package), requests.post, []

    def answer(url, **options):
        found = post(url, **options)
        if answers:
            found.status_code, found._content = answers.pop(0)
        return found

    monkeypatch.setattr(requests, "post", answer)
    answers += [(503, b"no server is free")]
    np.testing.assert_array_equal(client.simulate([0.5, 1.0]), line([0.5, 1.0]))
    for answers[:] in ([(503, b"busy")] * 2, [(200, b"<html>log in</html>")], [(404, b"gone")]):
        with pytest.raises(SimulationFailed, match="503|log in|gone") as failed:
            client.simulate([0.5, 1.0])
        assert isinstance(failed.value.reason, TransientReason) and not answers


@pytest.mark.parametrize("kind", ["misfits", pytest.param("draws", marks=pytest.mark.slow)])
def test_killed_server_is_waited_for_and_nothing_is_lost(kind):
    """The draws of the posterior, too, are those with the model in this process."""
    prior = {name: TruncatedNormal(1.0, 1.5, lower=0.0, upper=4.0) for name in NAMES}
    prior = Prior(prior | {"sigma_top": HalfNormal(0.3), "sigma_base": HalfNormal(0.3)})

    def values(likelihood):
        if kind == "misfits":
            return likelihood.misfit(np.random.default_rng(5).uniform(0.0, 3.5, (80, 2)))
        sampler = SMCSampler(40, 4, Posterior(likelihood, prior), vectorize=True, seed=5)
        sampler.run_mcmc(None, 1)
        return sampler.get_chain(flat=True)

    local = FELikelihood(model(), DATA)
    expected, served = values(local), []
    with ThreadPoolExecutor(3) as pool, ThreadPoolExecutor(1) as background, Process("package") as first:
        client = remote(first, retries=100, retry_wait=0.05)
        ask = client._ask
        client._ask = lambda request: (served.append(request), ask(request))[1]
        likelihood = FELikelihood(client, DATA, pool=pool)
        run = background.submit(values, likelihood)
        while len(served) < 20:
            time.sleep(0.002)
        first.process.kill()
        first.process.wait()
        assert not run.done()
        with Process("package", first.port):
            np.testing.assert_array_equal(run.result(), expected)
    failures = [part.simulator.failures for part in (local, likelihood)]
    assert failures[0].count == failures[1].count > 0 == failures[1].transient
    if kind == "draws":
        assert (np.abs(expected.mean(axis=0) - [1.0, 0.5, 0.1, 0.1]) < 4.0 * expected.std(axis=0)).all()


def test_server_that_dies_for_good_is_counted_and_not_stored(package, tmp_path):
    with Process("package") as dying:
        likelihood = FELikelihood(remote(dying), DATA, cache=SimulationCache(tmp_path / "cache.db"))
        thetas = np.vstack([THETAS[:3], [[1.0, 99.0]], THETAS[3:]])  # the server ends at 99
        values = likelihood(np.column_stack([thetas, np.full((9, 2), 0.1)]))
    failures = likelihood.simulator.failures
    np.testing.assert_array_equal(np.isneginf(values), np.arange(9) > 2)
    assert failures.count == failures.transient == 6
    assert all("(attempt 2)" in reason for reason in failures.reasons)
    later = FELikelihood(remote(package), DATA, cache=SimulationCache(tmp_path / "cache.db"))  # at another port
    np.testing.assert_array_equal(later.misfit(THETAS), FELikelihood(model(), DATA).misfit(THETAS))
    assert (later.simulations, later.simulator.disk_hits) == (5, 3)


def test_server_with_another_model_ends_the_run():
    with serve(model(), port=0, block=False) as server:
        likelihood = FELikelihood(remote(server), DATA)
        likelihood.misfit(THETAS[:2])
        port = int(server.url.rpartition(":")[2])
    for served in (model(names=(*NAMES, "more")), {"other": model()}):
        with serve(served, port=port, block=False), pytest.raises(UnusableModel, match="another model|'forward'"):
            likelihood.misfit(THETAS[2:4])


def test_time_limit_is_a_transient_failure():
    release = threading.Event()
    waits = model(lambda theta: line(theta) if release.wait(60.0) else None)
    with serve(waits, port=0, block=False) as server:
        with pytest.raises(SimulationFailed, match=r"timed out.*0\.2") as failed:
            remote(server, time_limit=0.2).simulate([1.0, 1.0])
        assert isinstance(failed.value.reason, TransientReason)
        release.set()
        np.testing.assert_array_equal(remote(server, time_limit=60.0).simulate([1.0, 1.0]), line([1.0, 1.0]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "backward"}, "model 'backward'.*Supported models are: \\['forward'\\]"),
        ({"parameter_names": ("offset",)}, r"takes vectors of sizes \[1, 1\]"),
        ({"channels": CHANNELS[:1]}, r"returns \[20, 20\]; got .* channels of sizes \[20\]"),
        ({"n_steps": 10}, r"channels of sizes \[10, 10\]"),
        ({"config": {"a": object()}}, "not JSON serializable"),
        ({"retries": -1}, "number of retries"),
        ({"retry_wait": np.nan}, "retry_wait"),
        ({"time_limit": 0.0}, "time_limit must be"),
        ({"output": len}, "with n_steps"),
        ({"url": "localhost:4242"}, "correct the address"),
    ],
)
def test_wrong_arguments_are_refused(package, changes, message):
    arguments = {"url": package.url, "name": "forward", "parameter_names": NAMES, "channels": CHANNELS, "dt": 0.1}
    with pytest.raises(ValueError, match=message):
        UMBridgeModel(**(arguments | changes))


def test_absent_server_wrong_thing_and_absent_package_are_named(package, monkeypatch):
    with pytest.raises(ConnectionError, match="Start it, or correct the address"):
        UMBridgeModel(f"http://127.0.0.1:{free_port()}", "forward", NAMES, CHANNELS, 0.1)
    with pytest.raises(ValueError, match="expected a posterior or a model as 'forward'; got function"):
        serve(line, port=0, block=False)
    with serve(model(), port=0, block=False) as server, pytest.raises(OSError, match="in use"):
        serve(model(), port=int(server.url.rpartition(":")[2]), block=False)
    monkeypatch.setitem(sys.modules, "umbridge", None)
    for use in (lambda: remote(package), lambda: serve(model())):
        with pytest.raises(ValueError, match=r"pip install 'fe-likelihoods\[umbridge\]'"):
            use()
