"""UM-Bridge both ways: served posteriors and models, and models of servers that die, change or answer errors."""

import importlib.util
import itertools
import json
import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import (
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
from fe_likelihoods.simulation.faults import ChangedModel, TransientReason
from fe_likelihoods.simulation.local_pool import LocalPool
from samplers import SMCSampler

from . import served
from .problem import CRITICAL, Exact, make_posterior
from .scoring import chains, check
from .served import CHANNELS, DT, NAMES, TIME, Process, line, line_model, runs_of

umbridge = pytest.importorskip("umbridge", reason="UMBRIDGE IS NOT INSTALLED: pip install umbridge")

THETAS = np.random.default_rng(3).uniform(0.0, 2.0, (24, 2))
DATA = Measurements(CHANNELS, DT, line([1.0, 0.5]) + 0.1 * np.random.default_rng(4).normal(size=(2, len(TIME))))


@pytest.fixture(scope="module")
def posterior():
    return make_posterior()


@pytest.fixture(scope="module")
def server(posterior):
    """A server in this process."""
    with serve({"line": line_model(), "posterior": posterior}, port=0, block=False) as running:
        yield running


def remote_line(urls, name="forward", **options):
    return UMBridgeModel(urls, name, NAMES, CHANNELS, DT, **({"retries": 1, "retry_wait": 0.01} | options))


def post(url, path, content):
    """Status and JSON of the answer."""
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    try:
        with urllib.request.urlopen(urllib.request.Request(url + path, body), timeout=60) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_posterior_is_served_with_all_digits(server, posterior):
    assert umbridge.supported_models(server.url) == ["line", "posterior"]
    client = umbridge.HTTPModel(server.url, "posterior")
    assert (client.get_input_sizes(), client.get_output_sizes()) == ([4], [1])
    points = posterior.sample_start(5, 1)
    assert [client([point.tolist()]) for point in points] == [[[value]] for value in posterior(points)]
    for density in ("log_prob", "log_prior", "log_likelihood"):
        expected = getattr(posterior, density)(points[0])
        assert client([points[0].tolist()], {"density": density}) == [[expected]], density


def test_density_of_zero_is_a_finite_number(server, posterior):
    client = umbridge.HTTPModel(server.url, "posterior")
    outside, failed = [1.0, 9.0, 0.5, 0.01], [1.0, CRITICAL + 0.1, 0.5, 0.01]
    for point in (outside, failed):
        assert posterior(np.array(point)) == -np.inf
        assert client([point]) == [[-1e100]]


def test_gradients_are_refused(server):
    client = umbridge.HTTPModel(server.url, "posterior")
    assert client.supports_evaluate()
    assert not (client.supports_gradient() or client.supports_apply_jacobian() or client.supports_apply_hessian())
    for action in ("Gradient", "ApplyJacobian", "ApplyHessian", "GradientShMem"):
        request = {"name": "posterior", "outWrt": 0, "inWrt": 0, "input": [[1.0] * 4], "sens": [1.0], "vec": [1.0]}
        status, answer = post(server.url, f"/{action}", request)
        assert status == 400 and answer["error"]["type"] == "UnsupportedFeature" and action in str(answer)


@pytest.mark.parametrize(
    ("name", "content", "config", "kind"),
    [
        ("posterior", [[1.0, 2.0]], {}, "InvalidInput"),
        ("posterior", [[1.0] * 4, []], {}, "InvalidInput"),
        ("posterior", [1.0] * 4, {}, "InvalidInput"),
        ("posterior", [["1"] * 4], {}, "InvalidInput"),
        ("posterior", [[np.nan] * 4], {}, "InvalidInput"),
        ("posterior", [[1.0] * 4], {"density": "fast"}, "InvalidInput"),
        ("posterior", [[1.0] * 4], {"level": 1}, "InvalidInput"),
        ("line", [[1.0, 2.0]], {"density": "log_prob"}, "InvalidInput"),
        ("column", [[1.0, 2.0]], {}, "ModelNotFound"),
    ],
)
def test_wrong_request_is_answered_with_what_was_expected(server, name, content, config, kind):
    status, answer = post(server.url, "/Evaluate", {"name": name, "input": content, "config": config})
    assert status == 400 and answer["error"]["type"] == kind
    assert "expected" in str(answer) or "must be one of" in str(answer)


def test_content_that_is_no_json_is_refused(server):
    for content in (b"", b"{", b"[1]"):
        assert post(server.url, "/Evaluate", content)[1]["error"]["type"] == "InvalidInput"
    assert post(server.url, "/Nothing", {"name": "line"})[0] == 404


def test_server_accepts_connections_of_this_machine_alone_unless_told(server):
    """Linux has the address 127.0.0.2 too, which stands for that of another network."""
    if sys.platform != "linux":
        pytest.skip("ONLY LINUX HAS A SECOND LOOPBACK ADDRESS")

    def connects(url):
        with socket.socket() as client:
            return client.connect_ex(("127.0.0.2", int(url.rpartition(":")[2]))) == 0

    assert not connects(server.url)
    with serve(line_model(), host="0.0.0.0", port=0, block=False) as everywhere:
        assert connects(everywhere.url)


def test_served_model_has_the_same_bits(server):
    model, remote = line_model(), remote_line(server.url, "line")
    assert remote.n_steps == len(TIME)
    for theta in [*THETAS[:5], np.array([1e-300, 1.0 / 3.0]), np.array([-0.0, 2.0**60])]:
        assert remote.simulate(theta).tobytes() == model.simulate(theta).tobytes()


def test_failures_keep_their_reason_and_their_kind(server):
    remote = remote_line(server.url, "line")
    with pytest.raises(SimulationFailed, match=r"^the offset is too large after [\d.e-]+ s$") as failed:
        remote.simulate([3.5, 1.0])
    assert not isinstance(failed.value.reason, TransientReason)
    with pytest.raises(SimulationFailed, match="no licence was free") as failed:
        remote.simulate([2.5, 1.0])
    assert isinstance(failed.value.reason, TransientReason)
    with pytest.raises(SimulationFailed, match="not finite"):
        remote.simulate([np.nan, 1.0])


def test_points_that_wait_are_evaluated_together_and_never_by_two_threads(posterior):
    class Counting:
        ndim, batches, running = 2, [], 0

        def log_prob(self, points):
            type(self).running += 1
            assert self.running == 1
            self.batches.append(len(points))
            if len(self.batches) == 1:
                assert others_wait.wait(60.0)
            type(self).running -= 1
            return points @ [1.0, 10.0]

    others_wait, target = threading.Event(), Counting()
    with serve({"a": target, "b": line_model()}, port=0, block=False) as server, ThreadPoolExecutor(25) as pool:
        evaluate = umbridge.HTTPModel(server.url, "a")
        first = pool.submit(evaluate, [[0.0, 1.0]])
        while not target.batches:
            time.sleep(0.001)
        others = [pool.submit(evaluate, [theta.tolist()]) for theta in THETAS]
        while server._http.batches._waiting.qsize() < len(others):
            time.sleep(0.001)
        others_wait.set()
        assert [first.result()] + [other.result() for other in others] == [[[10.0]]] + [
            [[value]] for value in (THETAS @ [1.0, 10.0]).tolist()
        ]
    assert target.batches == [1, 24]


def test_error_of_a_posterior_is_sent_and_the_server_goes_on(caplog):
    class Broken:
        ndim = 1

        def log_prob(self, points):
            if points[0, 0] < 0.0:
                raise RuntimeError("too many simulations have failed")
            return points[:, 0]

    caplog.set_level(logging.CRITICAL, logger="fe_likelihoods")
    with serve(Broken(), port=0, block=False) as server:
        client = umbridge.HTTPModel(server.url, "posterior")
        with pytest.raises(Exception, match="RuntimeError: too many simulations have failed"):
            client([[-1.0]])
        assert client([[2.0]]) == [[2.0]]
    server.close()  # a second time


def test_served_model_with_a_pool():
    with LocalPool(1) as pool, serve(line_model(), port=0, pool=1, block=False) as server:
        remote = remote_line(server.url)
        assert np.array_equal(remote.simulate([1.0, 2.0]), line([1.0, 2.0]))
        likelihoods = FELikelihood(remote, DATA, pool=pool), FELikelihood(line_model(), DATA)
        assert np.array_equal(*(likelihood.misfit(THETAS[:3]) for likelihood in likelihoods))


@pytest.mark.slow
def test_serve_ends_with_ctrl_c(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from fe_likelihoods.adapters import serve\n"
        "from tests.clients.served import line_model\n"
        f"serve(line_model(), port={(port := free_port())})\n"
        "print('done')\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(served.__file__).parents[2])}
    with subprocess.Popen([sys.executable, script], env=environment, stdout=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            with socket.socket() as client:
                if client.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.02)
        assert np.array_equal(remote_line(f"http://127.0.0.1:{port}").simulate([1.0, 2.0]), line([1.0, 2.0]))
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=60)[0] == "done\n" and process.returncode == 0


@pytest.mark.parametrize(
    ("thing", "options", "message"),
    [
        (line, {}, "expected a posterior or a model as 'forward'; got function"),
        ({}, {}, "an empty mapping"),
        (make_posterior, {"pool": 2}, "give it to the likelihood"),
    ],
)
def test_what_cannot_be_served_is_refused(thing, options, message):
    thing = thing() if thing is make_posterior else thing
    with pytest.raises(ValueError, match=message):
        serve(thing, port=0, block=False, **options)


def test_reference_server_with_blocks_a_configuration_and_errors(tmp_path):
    """The server of the package umbridge."""

    def join(vectors):
        return [np.concatenate(vectors)]

    def model(**options):
        settings = {"output": join, "n_steps": 5, "retries": 0} | options
        return UMBridgeModel(reference.url, "blocks", ("a", "b", "c"), CHANNELS[:1], DT, **settings)

    with Process("reference", free_port()) as reference:
        np.testing.assert_array_equal(model().simulate([0.5, 1.0, 1.0 / 3.0]), [[0.5, 1.0, 1.0 / 3.0, 0.5, 1.0]])
        doubled = model(config={"factor": 2.0})
        np.testing.assert_array_equal(doubled.simulate([0.5, 1.0, 3.0]), [[0.5, 1.0, 6.0, 0.5, 1.0]])
        assert len({model().fingerprint, doubled.fingerprint, model(version="2").fingerprint}) == 3
        assert model().fingerprint == model().fingerprint
        for theta, reason in (([1.5, 1.0, 1.0], "HTTP 500"), ([1.0, 1.0, 1.0], "contains nan")):
            with pytest.raises(SimulationFailed, match=reason) as failed:
                model().simulate(theta)
            assert not isinstance(failed.value.reason, TransientReason)
        with pytest.raises(ValueError, match=r"returns vectors of sizes \[2, 3\]: give n_steps= and output="):
            model(output=None, n_steps=None)
        with pytest.raises(ValueError, match=r"takes 3 numbers, in vectors of sizes \[1, 2\]; got 2 parameter_names"):
            UMBridgeModel(reference.url, "blocks", NAMES, CHANNELS, DT)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "forward"}, "expected a model named 'forward'.*'line', 'posterior'"),
        ({"name": "posterior"}, r"takes 4 numbers"),
        ({"channels": CHANNELS[:1]}, r"one vector of the same length.*returns vectors of sizes \[20, 20\]"),
        ({"n_steps": 10}, "n_steps=10 numbers"),
        ({"config": {"a": object()}}, "config must be a mapping"),
        ({"config": {"level": 1}}, "expected a config with no keys"),
        ({"retries": -1}, "retries must be"),
        ({"retry_wait": np.nan}, "retry_wait must be"),
        ({"time_limit": 0.0}, "time_limit must be"),
        ({"output": "file.txt"}, "output must be a function"),
        ({"output": len}, "give n_steps"),
        ({"urls": "localhost:4242"}, "expected the address of a server"),
        ({"urls": []}, "one or more different addresses"),
    ],
)
def test_wrong_arguments_are_refused(server, changes, message):
    arguments = {"urls": server.url, "name": "line", "parameter_names": NAMES, "channels": CHANNELS, "dt": DT}
    with pytest.raises(ValueError, match=message):
        UMBridgeModel(**(arguments | changes))


def test_absent_server_is_a_connection_error():
    with pytest.raises(ConnectionError, match="expected a server of UM-Bridge; .*Start it, or correct the address"):
        remote_line(f"http://127.0.0.1:{free_port()}")


def test_server_of_something_else_is_a_connection_error():
    class Page(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"<html>It works!</html>")

        def log_message(self, *arguments):
            pass

    with HTTPServer(("127.0.0.1", 0), Page) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        with pytest.raises(ConnectionError, match="not an answer of UM-Bridge: <html>"):
            remote_line(f"http://127.0.0.1:{other.server_port}")
        other.shutdown()


def test_fingerprint_is_that_of_the_model_and_not_of_the_address(server):
    with serve({"line": line_model()}, port=0, block=False) as second:
        assert remote_line(second.url, "line").fingerprint == remote_line(server.url, "line").fingerprint
        both = remote_line([server.url, second.url], "line")
        copy = pickle.loads(pickle.dumps(both))
        assert copy.fingerprint == both.fingerprint and copy.servers.urls == both.servers.urls
        assert np.array_equal(copy.simulate([1.0, 2.0]), line([1.0, 2.0]))


def test_several_servers_work_at_the_same_time():
    """Each simulation waits for one on the other server: negative control, one server alone does not end it."""

    def waits(limit):
        barrier = threading.Barrier(2)

        def meet(theta):
            barrier.wait(limit)
            return line(theta)

        return FunctionModel(meet, NAMES, CHANNELS, DT, len(TIME), version="meet")

    def responses(model, *urls):
        with ThreadPoolExecutor(2) as pool:
            likelihood = FELikelihood(remote_line(urls), DATA, pool=pool)
            return likelihood.simulate(THETAS[:6])

    model = waits(60.0)
    with serve(model, port=0, block=False) as one, serve(model, port=0, block=False) as two:
        batch = responses(model, one.url, two.url)
    assert not any(batch.reasons)
    np.testing.assert_array_equal(batch.response, [line(theta) for theta in THETAS[:6]])
    with serve(waits(0.05), port=0, block=False) as alone:
        assert all(responses(model, alone.url).reasons)


def test_time_limit_is_a_transient_failure():
    release = threading.Event()

    def waits(theta):
        release.wait(60.0)
        return line(theta)

    model = FunctionModel(waits, NAMES, CHANNELS, DT, len(TIME), version="waits")
    with serve(model, port=0, block=False) as server:
        remote = remote_line(server.url, time_limit=0.2)
        with pytest.raises(SimulationFailed, match="stopped at the time limit of 0.2 s") as failed:
            remote.simulate([1.0, 1.0])
        assert failed.value.reason.time_limit == 0.2
        release.set()
        np.testing.assert_array_equal(remote_line(server.url, time_limit=60.0).simulate([1.0, 1.0]), line([1.0, 1.0]))


def hold_after(folder, count):
    """Let the runs of `served.held_line` after the first `count` wait."""
    part = folder / "limit.part"
    part.write_text(str(count))
    part.replace(folder / "limit")


def wait_for_runs(folder, count):
    while len(runs_of(folder)) < count:
        time.sleep(0.005)


def test_killed_server_is_waited_for_and_nothing_is_lost(tmp_path, caplog):
    hold_after(tmp_path, 5)
    first = Process("held line", folder=tmp_path)
    remote = remote_line(first.url, retries=20, retry_wait=0.1)
    caplog.set_level(logging.WARNING, logger="fe_likelihoods")
    with ThreadPoolExecutor(3) as pool, ThreadPoolExecutor(1) as background:
        likelihood = FELikelihood(remote, DATA, pool=pool)
        run = background.submit(likelihood.misfit, THETAS)
        wait_for_runs(tmp_path, 5)
        first.kill()
        assert not run.done()
        hold_after(tmp_path, 10**6)
        with Process("held line", first.port, tmp_path):
            misfit = run.result()
    np.testing.assert_array_equal(misfit, FELikelihood(line_model(), DATA).misfit(THETAS))
    assert (likelihood.simulator.failures.count, likelihood.simulations) == (0, len(THETAS))
    assert "The request is repeated" in caplog.text and "answers again" in caplog.text


def test_one_of_two_servers_dies_for_good(tmp_path):
    hold_after(tmp_path, 1)
    dying, living = Process("held line", folder=tmp_path), Process("line")
    with living, ThreadPoolExecutor(2) as pool, ThreadPoolExecutor(1) as background:
        likelihood = FELikelihood(remote_line([dying.url, living.url]), DATA, pool=pool)
        run = background.submit(likelihood.misfit, THETAS)
        wait_for_runs(tmp_path, 1)
        dying.kill()
        misfit = run.result()
    np.testing.assert_array_equal(misfit, FELikelihood(line_model(), DATA).misfit(THETAS))
    assert likelihood.simulator.failures.count == 0


def test_server_that_dies_for_good_is_counted_and_not_stored(tmp_path):
    cache = tmp_path / "cache.db"
    hold_after(tmp_path, 5)
    dying = Process("held line", folder=tmp_path)
    with ThreadPoolExecutor(1) as background:
        likelihood = FELikelihood(remote_line(dying.url), DATA, cache=SimulationCache(cache))
        run = background.submit(likelihood, np.column_stack([THETAS, np.full((24, 2), 0.1)]))
        wait_for_runs(tmp_path, 5)
        dying.kill()
        values = run.result()
    lost = np.isneginf(values)
    assert 0 < lost.sum() < 24
    assert likelihood.simulator.failures.count == likelihood.simulator.failures.transient == lost.sum()
    assert {failure["parameters"]["offset"] for failure in likelihood.simulator.failures.records} == set(
        THETAS[lost, 0]
    )
    assert all("(2 attempts)" in reason for reason in likelihood.simulator.failures.reasons)

    with Process("line") as again:  # at another port: the stored simulations are those of the same model
        later = FELikelihood(remote_line(again.url), DATA, cache=SimulationCache(cache))
        misfit = later.misfit(THETAS)
        assert later.simulations == lost.sum() and later.simulator.disk_hits == 24 - lost.sum()
    np.testing.assert_array_equal(misfit, FELikelihood(line_model(), DATA).misfit(THETAS))


def test_server_with_another_model_ends_the_run():
    with serve(line_model(), port=0, block=False) as server:
        likelihood = FELikelihood(remote_line(server.url), DATA)
        likelihood.misfit(THETAS[:2])
    port = int(server.url.rpartition(":")[2])
    other = FunctionModel(lambda theta: line(theta), (*NAMES, "more"), CHANNELS, DT, len(TIME), version="other")
    with serve(other, port=port, block=False), pytest.raises(ChangedModel, match="no longer has the model 'forward'"):
        likelihood.misfit(THETAS[2:4])


@pytest.mark.slow
def test_sampler_whose_server_is_killed_again_and_again(tmp_path):
    """Six kills by SIGKILL during a run: every evaluation is that of the model in this process."""
    prior = Prior(
        {name: TruncatedNormal(1.0, 0.5, lower=0.0, upper=2.4) for name in NAMES}
        | {"sigma_top": HalfNormal(0.3), "sigma_base": HalfNormal(0.3)}
    )

    def chain(model, pool=None):
        posterior = Posterior(FELikelihood(model, DATA, pool=pool), prior)
        sampler = SMCSampler(40, posterior.ndim, posterior, vectorize=True, seed=1)
        sampler.run_mcmc(None, 2)
        return sampler.get_chain(), sampler.log_evidence, posterior.report()

    expected, evidence, report = chain(line_model())
    limits = [kill * report["simulations"] // 8 for kill in range(1, 7)] + [10**6]
    hold_after(tmp_path, limits[0])
    server = Process("held line", folder=tmp_path)
    remote = remote_line(server.url, retries=30, retry_wait=0.1)
    with ThreadPoolExecutor(4) as pool, ThreadPoolExecutor(1) as background:
        run = background.submit(chain, remote, pool)
        for limit, following in itertools.pairwise(limits):
            wait_for_runs(tmp_path, limit)
            assert not run.done()
            server.kill()
            hold_after(tmp_path, following)
            server = Process("held line", server.port, tmp_path)
        with server:
            samples, remote_evidence, remote_report = run.result()
    np.testing.assert_array_equal(samples, expected)
    assert remote_evidence == evidence and remote_report["failure_count"] == 0
    assert remote_report["simulations"] == report["simulations"]


def tinyda(url, kind, **settings):
    """Chains (n_chains, n_draws, ndim) of tinyDA, in the environment whose python is in TINYDA_PYTHON."""
    python = os.environ.get("TINYDA_PYTHON") or (sys.executable if importlib.util.find_spec("tinyDA") else "")
    if not python:
        reason = (
            "TINYDA IS NOT INSTALLED: make its environment as .ci/clients does, and set TINYDA_PYTHON to its python"
        )
        if "tinyDA" in os.environ.get("REQUIRED_CLIENTS", "").split(","):
            pytest.fail(reason)
        pytest.skip(reason)
    script = Path(served.__file__).with_name("tinyda_chain.py")
    command, given = [python, str(script), url, kind], json.dumps(settings)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, input=given, capture_output=True, text=True, timeout=500, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return np.array(json.loads(done.stdout))


@pytest.mark.slow
def test_tinyda_samples_a_served_model(seed):
    """Linear model, normal prior and noise: the posterior is normal with known moments."""
    sigma, mean, covariance = 0.5, np.array([0.5, 0.2]), np.diag([0.5, 0.3]) ** 2
    data = line([1.0, 0.5]).ravel() + sigma * np.random.default_rng(seed).normal(size=2 * len(TIME))
    design = np.column_stack([line([1.0, 0.0]).ravel(), line([0.0, 1.0]).ravel()])
    precision = np.linalg.inv(covariance) + design.T @ design / sigma**2
    posterior_covariance = np.linalg.inv(precision)
    right = np.linalg.solve(covariance, mean) + design.T @ data / sigma**2
    answer = Exact(posterior_covariance @ right, np.sqrt(np.diag(posterior_covariance)), np.nan)
    starts = np.random.default_rng(seed).multivariate_normal(answer.mean, posterior_covariance, 4)
    settings = {"mean": mean.tolist(), "covariance": covariance.tolist(), "data": data.tolist(), "sigma": sigma}
    settings |= {"step": (2.0 * posterior_covariance).tolist(), "starts": starts.tolist(), "seed": seed}
    with Process("line") as server:
        found = chains(tinyda(server.url, "forward", draws=2000, burn_in=100, **settings))
    check(found, answer)
    with pytest.raises(AssertionError, match="means"):  # negative control: half a standard deviation
        check(found, answer._replace(mean=answer.mean + 0.5 * answer.sd))


@pytest.mark.slow
def test_tinyda_samples_a_served_posterior(answer, seed):
    """Its simulations fail in three fifths of the prior, where the served log-density is -1e100."""
    settings = {"starts": make_posterior().sample_start(4, seed).tolist(), "seed": seed}
    settings |= {"scale": (0.5 * answer.sd).tolist(), "draws": 4000, "burn_in": 1000}
    with Process("posterior") as server:
        found = chains(tinyda(server.url, "posterior", **settings))
    check(found, answer)
