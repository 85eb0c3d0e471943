"""Access to the service: TLS, token, loopback; with certificates made here."""

import datetime
import ipaddress
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import served

from graphvio.errors import ServiceError

pytest.importorskip("grpc")
pytest.importorskip("cryptography")

import grpc
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from graphvio.slam.client import Client, read_token
from graphvio.slam.service.options import ServiceOptions, is_loopback
from graphvio.slam.service.server import GrpcServer

TOKEN = "0123456789abcdef" * 2


@dataclass(frozen=True)
class Files:
    ca: Path
    other_ca: Path
    certificate: Path
    key: Path
    expired: Path
    token: Path


def signed(
    subject: str, issuer: str, key: Any, by: Any, is_ca: bool, days: float = 1.0, names: tuple[str, ...] = ()
) -> x509.Certificate:
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, subject)]))
        .issuer_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, issuer)]))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=2))
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=is_ca, path_length=None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(by.public_key()), critical=False)
    )
    usages = ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement")
    usage: dict[str, bool] = dict.fromkeys(usages, False)
    usage["digital_signature"] = True
    builder = builder.add_extension(
        x509.KeyUsage(**usage, key_cert_sign=is_ca, crl_sign=is_ca, encipher_only=False, decipher_only=False),
        critical=True,
    )
    if names:
        hosts = [x509.DNSName(name) if name.isalpha() else x509.IPAddress(ipaddress.ip_address(name)) for name in names]
        builder = builder.add_extension(x509.SubjectAlternativeName(hosts), critical=False)
    return builder.sign(by, hashes.SHA256())


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("tls")

    def write(name: str, content: bytes) -> Path:
        (folder / name).write_bytes(content)
        (folder / name).chmod(0o600)
        return folder / name

    def pem(certificate: x509.Certificate) -> bytes:
        return certificate.public_bytes(serialization.Encoding.PEM)

    root, other, own = (ec.generate_private_key(ec.SECP256R1()) for _ in range(3))
    private = own.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    names = ("localhost", "127.0.0.1")
    return Files(
        ca=write("ca.pem", pem(signed("root", "root", root, root, True))),
        other_ca=write("other.pem", pem(signed("other", "other", other, other, True))),
        certificate=write("server.pem", pem(signed("server", "root", own, root, False, names=names))),
        key=write("server.key", private),
        expired=write("expired.pem", pem(signed("server", "root", own, root, False, -1.0, names))),
        token=write("token", f"{TOKEN}\n".encode()),
    )


@pytest.fixture
def odometry() -> Iterator[served.SyntheticOdometry]:
    synthetic = served.SyntheticOdometry()
    synthetic.keyframe_log.add(served.keyframe(0))
    yield synthetic
    synthetic.end()


@pytest.fixture
def secure(odometry: served.SyntheticOdometry, files: Files) -> Iterator[GrpcServer]:
    options = ServiceOptions("0.0.0.0", 0, files.certificate, files.key, files.token)
    with GrpcServer(odometry, options) as server:
        yield server


def at_home(server: GrpcServer) -> str:
    return f"127.0.0.1:{server.address.rpartition(':')[2]}"


def test_all_calls_work_with_tls_and_token(secure: GrpcServer, files: Files) -> None:
    assert secure.address.startswith("0.0.0.0:")
    for address in (at_home(secure), at_home(secure).replace("127.0.0.1", "localhost")):
        with Client(address, files.ca, read_token(files.token)) as client:
            assert next(client.keyframes()).id == 0
            assert client.status() == {}


def test_wrong_or_missing_token_is_refused_for_every_call(
    secure: GrpcServer, files: Files, odometry: served.SyntheticOdometry
) -> None:
    for token in (None, TOKEN[:-1], TOKEN + "0", TOKEN.upper(), "x" * 4096):
        with pytest.raises(ServiceError, match="the token is missing or wrong; give the one in the server's token"):
            Client(at_home(secure), files.ca, token)
    credentials = grpc.ssl_channel_credentials(files.ca.read_bytes())
    methods = ("GetInfo", "GetStatus", "StreamEstimates", "StreamKeyframes", "StreamEvents", "Correct", "Nonsense")
    both = ("authorization", f"Bearer {TOKEN}"), ("authorization", "Bearer wrong")
    with grpc.secure_channel(at_home(secure), credentials) as channel:
        for method in methods:
            for metadata in ((), (("authorization", TOKEN),), (("authorization", f"bearer {TOKEN}"),), both):
                call = channel.unary_unary(f"/graphvio.v1.FrontEnd/{method}")
                with pytest.raises(grpc.RpcError) as caught:
                    call(b"", metadata=metadata, timeout=10.0)
                assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED, method
    assert not odometry.corrections


def test_silent_calls_without_token_hold_no_thread(secure: GrpcServer, files: Files) -> None:
    credentials = grpc.ssl_channel_credentials(files.ca.read_bytes())
    silent = [
        grpc.secure_channel(at_home(secure), credentials, [("grpc.use_local_subchannel_pool", 1)]) for _ in range(10)
    ]
    calls = []
    enough = threading.Event()

    def silence() -> Iterator[bytes]:
        enough.wait()
        yield from ()

    for channel in silent:
        for _ in range(10):
            method = channel.stream_unary("/graphvio.v1.FrontEnd/GetInfo")
            calls.append(method.future(silence(), timeout=30.0))
    with Client(at_home(secure), files.ca, TOKEN) as client:
        assert client.info().next_keyframe_id == 1
    assert not enough.is_set()
    for call in calls:
        assert call.code() is grpc.StatusCode.UNAUTHENTICATED
    enough.set()
    for channel in silent:
        channel.close()


def test_token_on_the_loopback_works_without_tls(odometry: served.SyntheticOdometry, files: Files) -> None:
    with GrpcServer(odometry, ServiceOptions(port=0, token_file=files.token)) as server:
        with Client(server.address, token=TOKEN) as client:
            assert client.info().next_keyframe_id == 1
        with pytest.raises(ServiceError, match="token is missing"):
            Client(server.address)


def test_client_without_tls_or_with_wrong_certificate_raises(secure: GrpcServer, files: Files) -> None:
    address = at_home(secure)
    with pytest.raises(ServiceError, match=f"{address}: it demands TLS; give the certificate of its issuer"):
        Client(address, token=TOKEN)
    with pytest.raises(ServiceError, match=r"its certificate is not trusted \(.*issuer certificate"):
        Client(address, files.other_ca, TOKEN)


def test_name_missing_in_the_certificate_raises(odometry: served.SyntheticOdometry, files: Files) -> None:
    options = ServiceOptions("127.0.0.2", 0, files.certificate, files.key, files.token)
    with (
        GrpcServer(odometry, options) as server,
        pytest.raises(ServiceError, match=r"not trusted \(IP address mismatch"),
    ):
        Client(server.address, files.ca, TOKEN)


def test_expired_certificate_raises(odometry: served.SyntheticOdometry, files: Files) -> None:
    options = ServiceOptions("127.0.0.1", 0, files.expired, files.key, files.token)
    with (
        GrpcServer(odometry, options) as server,
        pytest.raises(ServiceError, match=r"not trusted \(certificate has expired"),
    ):
        Client(server.address, files.ca, TOKEN)


def test_client_with_tls_of_a_server_without_raises(odometry: served.SyntheticOdometry, files: Files) -> None:
    with (
        GrpcServer(odometry, ServiceOptions(port=0)) as server,
        pytest.raises(ServiceError, match="it does not use TLS, or is no graphvio service"),
    ):
        Client(server.address, files.ca)


def test_token_is_never_sent_unencrypted_through_a_network() -> None:
    with pytest.raises(ServiceError, match=r"robot:50551: the token would go through the network unencrypted"):
        Client("robot", token=TOKEN)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "robot", "128.0.0.1", "localhost.example.org", ""])
def test_public_addresses_need_tls_and_token(host: str, files: Files) -> None:
    whole = ServiceOptions(host, 0, files.certificate, files.key, files.token)
    for partial in ({"token_file": None}, {"certificate": None, "key": None}):
        with pytest.raises(ServiceError, match="can be reached from other machines, so it needs a TLS certificate"):
            replace(whole, **partial)  # type: ignore[arg-type]


def test_is_loopback() -> None:
    assert all(is_loopback(host) for host in ("127.0.0.1", "127.8.9.1", "::1", "localhost"))
    assert ServiceOptions("localhost", 7).address == "127.0.0.1:7"
    assert ServiceOptions("::1", 7).address == "[::1]:7"


def test_invalid_options_raise(files: Files) -> None:
    for options, text in (
        ({"port": -1}, "port -1 does not exist"),
        ({"port": 70000}, "port 70000 does not exist"),
        ({"max_clients": 0}, "max_clients is 0"),
        ({"keepalive_s": 0.0}, "keepalive_s is 0.0"),
        ({"keepalive_s": float("nan")}, "keepalive_s is nan"),
        ({"key": files.key}, "a TLS key is given without its certificate"),
        ({"certificate": files.certificate}, "a TLS certificate is given without its key"),
    ):
        with pytest.raises(ServiceError, match=text):
            ServiceOptions(**options)


def test_public_and_invalid_token_files_raise(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    for mode in (0o640, 0o604, 0o620):
        file.chmod(mode)
        with pytest.raises(ServiceError, match=f"by other users .mode {mode:o}.; run  chmod 600 {file}"):
            read_token(file)
    file.chmod(0o600)
    assert read_token(file) == TOKEN
    for content in (b"", b"short", b"two words are none", b"first-line-of-token\nsecond", b"\xff" * 32, b"x" * 5000):
        file.write_bytes(content)
        with pytest.raises(ServiceError, match="is no token: one line of 16 to 4096"):
            read_token(file)
    with pytest.raises(ServiceError, match=r"the token cannot be read \(No such file"):
        read_token(tmp_path / "absent")


def test_unusable_certificates_raise(odometry: served.SyntheticOdometry, files: Files, tmp_path: Path) -> None:
    def start(certificate: Path, key: Path) -> None:
        GrpcServer(odometry, ServiceOptions("0.0.0.0", 0, certificate, key, files.token)).start()

    with pytest.raises(ServiceError, match="are no TLS certificate and key"):
        start(files.other_ca, files.key)
    with pytest.raises(ServiceError, match="are no TLS certificate and key"):
        start(files.certificate, files.token)
    with pytest.raises(ServiceError, match=r"No such file"):
        start(tmp_path / "absent", files.key)
    with pytest.raises(ServiceError, match="the TLS key cannot be read"):
        start(files.certificate, tmp_path / "absent")
    loose = tmp_path / "loose.key"
    loose.write_bytes(files.key.read_bytes())
    loose.chmod(0o644)
    with pytest.raises(ServiceError, match="the TLS key can be read or changed by other users"):
        start(files.certificate, loose)
    key = serialization.load_pem_private_key(files.key.read_bytes(), None)
    locked = tmp_path / "locked.key"
    locked.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"word"),
        )
    )
    locked.chmod(0o600)
    with pytest.raises(ServiceError, match="the key without a password"):
        start(files.certificate, locked)
    with pytest.raises(ServiceError, match="holds no certificates"):
        Client("localhost", files.token)
    with pytest.raises(ServiceError, match="cannot be read"):
        Client("localhost", tmp_path / "absent")


@pytest.mark.parametrize("address", ["", ":1", "host:", "host:0", "host:65536", "host:x", "::1:7", "host:\uff11"])
def test_invalid_address_raises(address: str) -> None:
    with pytest.raises(ServiceError, match="is not an address; give HOST:PORT"):
        Client(address)


def test_absent_and_other_servers_raise(tmp_path: Path) -> None:
    import socket

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(ServiceError, match=f"127.0.0.1:{port}: nothing listens there"):
            Client(f"127.0.0.1:{port}")
    with pytest.raises(ServiceError, match="there is no such host"):
        Client("nowhere.invalid")
