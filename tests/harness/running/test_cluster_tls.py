"""Tests of runs over TLS on Dask, with certificates of Dask's configuration."""

import subprocess
import sys

import pytest

from mortarbench.cli.main import main
from mortarbench.harness import InputError, Verdict
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.running.cluster import on_cluster
from mortarbench.registries import Registries
from tests.harness.running.test_cluster import Cluster, measured
from tests.support import TOY_PROBLEM

SUITE = """
name = "toy_problem"
repeats = 1
time_limit = 30
solvers = ["exact"]
[[problems]]
family = "well"
params = { depth = [1, 2], n = 3 }
forms = ["dual"]
"""


def certificates(folder):
    """Create a CA and a certificate; return entries of Dask's configuration."""
    names = {n: str(folder / n) for n in ("ca.key", "ca.crt", "our.key", "our.crt")}

    def openssl(*arguments):
        subprocess.run(["openssl", *arguments], check=True, capture_output=True)

    new = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    openssl(
        "req", "-x509", *new, "-days", "2", "-subj", "/CN=authority",
        "-keyout", names["ca.key"], "-out", names["ca.crt"],
    )  # fmt: skip
    request = str(folder / "our.csr")
    openssl(
        "req", *new, "-subj", "/CN=127.0.0.1", "-keyout", names["our.key"],
        "-out", request,
    )  # fmt: skip
    openssl(
        "x509", "-req", "-days", "2", "-in", request, "-CA", names["ca.crt"],
        "-CAkey", names["ca.key"], "-CAcreateserial", "-out", names["our.crt"],
    )  # fmt: skip
    who = ("client", "scheduler", "worker")
    return {
        "ca-file": names["ca.crt"],
        **{f"{name}.cert": names["our.crt"] for name in who},
        **{f"{name}.key": names["our.key"] for name in who},
    }


def in_environment(credentials):
    """Convert entries of Dask's configuration to environment variables."""
    return {
        "DASK_DISTRIBUTED__COMM__TLS__"
        + key.upper().replace(".", "__").replace("-", "_"): value
        for key, value in credentials.items()
    }


@pytest.mark.slow
def test_a_suite_is_measured_over_tls_with_dask_s_own_configuration(
    tmp_path, monkeypatch, forks
):
    import dask
    import distributed  # noqa: F401  # adds its part to the configuration

    credentials = certificates(tmp_path)
    for name, value in in_environment(credentials).items():
        monkeypatch.setenv(name, value)
    cluster = Cluster(tmp_path, forks, "--protocol", "tls")
    (tmp_path / "toy.toml").write_text(SUITE)
    nothing = {"reference": None}
    plugin = load_plugin(TOY_PROBLEM)
    registries = Registries(
        families=plugin.problems,
        solvers=plugin.solvers,
        report=lambda *_, **__: ([], []),
        start=(sys.executable, "-P", str(TOY_PROBLEM)),
        **nothing,
    )
    try:
        cluster.join()
        assert cluster.address.startswith("tls://")
        # Dask read the environment of this process when it was imported
        told = {f"distributed.comm.tls.{k}": v for k, v in credentials.items()}
        with dask.config.set(told):
            code = main(registries, [
                "run", str(tmp_path / "toy.toml"), "--out", str(tmp_path / "out"),
                "--dask", cluster.address,
            ])  # fmt: skip
    finally:
        cluster.close()

    assert code == 0
    assert set(measured(tmp_path / "out").values()) == {Verdict.VERIFIED}


def test_missing_certificates_are_reported_in_one_line():
    cluster = on_cluster(
        "tls://127.0.0.1:9", plugins=[], operators={}, environment={}, keep=None,
        warn=None,
    )  # fmt: skip
    with (
        pytest.raises(
            InputError, match=r"no scheduler answers \(TLS expects .* TLS configuration"
        ),
        cluster,
    ):
        pass
