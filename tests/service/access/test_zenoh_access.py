"""Who is turned away and what is dropped, on real Zenoh sessions; the shipped link files and documented commands."""

import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import pytest
import trustme
import zenoh
import zenoh.ext

from models.signals.link import LinkSettings, TlsSettings, load_link
from models.signals.recording import read_recording
from service.runtime.runtime import Runtime, running
from service.settings.service import HttpSettings, MachineEntry, ServiceSettings
from service.stream.transport import Link, TopicMessage, follow
from simulator.publisher import PublishError, PublishSettings, publish
from tests.loopback import session_of
from tests.service.access.plant import GRANTS, PUMP, Plant, at_once, kept, plant
from tests.service.rig.live import LAB, ROOT, Program, advanced_publisher, endpoint, program, until
from tests.sure import sure


@pytest.fixture
def router(tmp_path: Path) -> Iterator[Plant]:
    with plant(tmp_path) as found:
        yield found


def knock(link: LinkSettings) -> None:
    """Publish nothing: this tests only whether the program is let in."""
    publish(LAB, iter(()), PublishSettings(link=link, linger_s=0.0, pace=1.0))


def text_of(reply: zenoh.Reply) -> str:
    return sure(reply.ok).payload.to_string()


def test_only_the_right_user_and_password_are_let_in(router: Plant, tmp_path: Path) -> None:
    knock(router.link("lab"))
    kept(tmp_path / "wrong", "wrong-word")
    wrong = router.link("lab").model_copy(update={"password_file": tmp_path / "wrong"})
    stranger = router.link("lab").model_copy(update={"user": "stranger"})
    anonymous = LinkSettings(mode="client", connect=(router.address,))
    for link, reason in (
        (wrong, f"does not accept the user lab with the password in {tmp_path / 'wrong'}"),
        (stranger, "does not accept the user stranger"),
        (anonymous, "requires a user name, and link.user has none"),
    ):
        with pytest.raises(PublishError, match=re.escape(reason)) as caught:
            knock(link)
        assert router.address in str(caught.value)
        assert "wrong-word" not in str(caught.value)


@dataclass(frozen=True, slots=True)
class Authority:
    folder: Path
    issuer: trustme.CA

    def tls(self, name: str, *hosts: str, trusted: Path | None = None) -> TlsSettings:
        issued = self.issuer.issue_cert(*(hosts or (f"{name}.plant",)), common_name=name)
        root = self.folder / f"{name}.ca"
        self.issuer.cert_pem.write_to_path(str(root))
        issued.cert_chain_pems[0].write_to_path(str(self.folder / f"{name}.pem"))
        kept(self.folder / f"{name}.key", issued.private_key_pem.bytes().decode())
        return TlsSettings(
            root_certificate=trusted or root,
            certificate=self.folder / f"{name}.pem",
            key=self.folder / f"{name}.key",
            mutual=True,
        )


def test_only_a_certificate_of_the_authority_is_let_in(tmp_path: Path) -> None:
    ours, foreign = Authority(tmp_path, trustme.CA()), Authority(tmp_path, trustme.CA())
    address = endpoint().replace("tcp/", "tls/")
    served = ours.tls("router", "127.0.0.1")
    with session_of(LinkSettings(mode="router", listen=(address,), tls=served, grants=GRANTS)):
        good = ours.tls("lab")
        knock(LinkSettings(mode="client", connect=(address,), tls=good))
        for tls, reason in (
            (good.model_copy(update={"mutual": False}), "requires a client certificate"),
            (foreign.tls("rogue", trusted=good.root_certificate), "rogue.pem was not issued by the authority"),
            (foreign.tls("other"), "the other side's certificate was not issued by"),
        ):
            with pytest.raises(PublishError, match=reason):
                knock(LinkSettings(mode="client", connect=(address,), tls=tls))
        with pytest.raises(PublishError, match="the other side serves only tls/ endpoints"):
            knock(LinkSettings(mode="client", connect=(address.replace("tls/", "tcp/"),)))


def test_a_router_under_another_name_is_not_trusted(tmp_path: Path) -> None:
    ours = Authority(tmp_path, trustme.CA())
    address = endpoint().replace("tcp/", "tls/")
    router = LinkSettings(mode="router", listen=(address,), tls=ours.tls("router", "another.plant"))
    with session_of(router), pytest.raises(PublishError, match="another name than the endpoint's"):
        knock(LinkSettings(mode="client", connect=(address,), tls=ours.tls("lab")))


def test_a_certificates_common_name_is_the_name_in_the_grants(tmp_path: Path) -> None:
    ours = Authority(tmp_path, trustme.CA())
    address = endpoint().replace("tcp/", "tls/")
    link = LinkSettings(mode="router", listen=(address,), tls=ours.tls("router", "127.0.0.1"), grants=GRANTS)
    with session_of(link) as session:
        heard: list[str] = []
        session.declare_subscriber("rotorwatch/**", at_once(lambda sample: heard.append(str(sample.key_expr))))
        with session_of(LinkSettings(mode="client", connect=(address,), tls=ours.tls("stranger"))) as stranger:
            for number, name in enumerate(("lab", "pump"), start=1):
                stranger.put(LAB.keys.stream, "stranger", congestion_control=zenoh.CongestionControl.BLOCK)
                with session_of(LinkSettings(mode="client", connect=(address,), tls=ours.tls(name))) as client:
                    for keys in (PUMP, LAB.keys, PUMP):
                        client.put(keys.stream, name, congestion_control=zenoh.CongestionControl.BLOCK)
                    until(lambda number=number: len(heard) >= number + number // 2, f"stream of {name}")  # type: ignore[misc]
        assert heard == [LAB.keys.stream, PUMP.stream, PUMP.stream]


@pytest.mark.parametrize(
    ("who", "key", "owner"),
    [
        ("lab", PUMP.stream, "pump"), ("lab", PUMP.descriptor, "pump"),
        ("lab", f"{PUMP.stream}/@adv/pub/1a/2/_", "pump"), ("lab", LAB.keys.alarm_event, "monitor"),
        ("lab", LAB.keys.alarm_state, "monitor"), ("lab", LAB.keys.health, "monitor"),
        ("monitor", LAB.keys.stream, "lab"), ("all", LAB.keys.stream, "lab"), ("all", LAB.keys.descriptor, "lab"),
        ("all", LAB.keys.alarm_event, "monitor"), ("all", LAB.keys.health, "monitor"),
        ("all", LAB.keys.report, "monitor"), ("one", PUMP.health, "monitor"),
    ],
)  # fmt: skip
def test_messages_without_a_grant_are_dropped(router: Plant, who: str, key: str, owner: str) -> None:
    router.session.declare_queryable(LAB.keys.health, lambda query: query.reply(LAB.keys.health, "fine"))
    with router.client(who) as refused, router.client(owner) as granted:
        refused.put(key, "refused", congestion_control=zenoh.CongestionControl.BLOCK)
        own = {"lab": LAB.keys.stream, "monitor": LAB.keys.report}.get(who)
        if own is not None:  # the link still carries what is allowed
            refused.put(own, "own", congestion_control=zenoh.CongestionControl.BLOCK)
            router.until_heard(own, "own")
        # A query behind it on the same link: once it is answered, the message has been handled.
        assert [text_of(reply) for reply in refused.get(LAB.keys.health, timeout=60.0)] == ["fine"]
        granted.put(key, "granted", congestion_control=zenoh.CongestionControl.BLOCK)
        router.until_heard(key, "granted")
    assert [text for heard, text in router.heard if heard == key] == ["granted"]


def test_only_the_monitor_can_answer_queries_for_its_keys(router: Plant) -> None:
    key = LAB.keys.health
    with router.client("lab") as publisher, router.client("monitor") as monitor, router.client("all") as viewer:
        publisher.declare_queryable(key, lambda query: query.reply(key, "forged"))
        publisher.put(LAB.keys.stream, "declared", congestion_control=zenoh.CongestionControl.BLOCK)
        router.until_heard(LAB.keys.stream, "declared")
        monitor.declare_queryable(key, lambda query: query.reply(key, "true"))
        monitor.put(LAB.keys.report, "declared", congestion_control=zenoh.CongestionControl.BLOCK)
        router.until_heard(LAB.keys.report, "declared")
        answers = [text_of(reply) for reply in viewer.get(key, target=zenoh.QueryTarget.ALL, timeout=60.0)]
    assert answers == ["true"]


def test_liveliness_tokens_are_accepted_only_from_their_owner(router: Plant) -> None:
    alive: list[str] = []
    router.session.liveliness().declare_subscriber(
        "rotorwatch/**", at_once(lambda sample: alive.append(str(sample.key_expr))), history=True
    )
    wanted = [LAB.keys.publisher_alive, PUMP.publisher_alive, LAB.keys.monitor_alive, LAB.keys.replay_alive]
    own = {"lab": [LAB.keys.publisher_alive], "monitor": [LAB.keys.monitor_alive], "all": []}
    with (
        router.client("all") as viewer,
        router.client("one") as other,
        router.client("lab") as lab,
        router.client("monitor") as monitor,
    ):
        tokens = [
            session.liveliness().declare_token(key)
            for session in (viewer, lab, monitor)
            for key in (*wanted[1:], wanted[0])
        ]
        # A query behind the tokens on each link.
        router.session.declare_queryable(LAB.keys.health, lambda query: query.reply(LAB.keys.health, "fine"))
        for session in (viewer, lab, monitor):
            assert [text_of(reply) for reply in session.get(LAB.keys.health, timeout=60.0)] == ["fine"]
        until(lambda: len(alive) >= 2, "tokens")
        assert sorted(alive) == sorted(key for keys in own.values() for key in keys)
        seen = [str(r.ok.key_expr) for r in other.liveliness().get("rotorwatch/demo/lab/alive/*", timeout=60.0) if r.ok]
        assert sorted(seen) == sorted(alive)
        assert len(tokens) == 12


def test_a_viewer_reads_no_more_than_its_grant(router: Plant) -> None:
    def listen(session: zenoh.Session, into: list[str]) -> None:
        def hear(sample: zenoh.Sample) -> None:
            into.append(str(sample.key_expr))

        for key in (PUMP.health, PUMP.alarm_event, LAB.keys.stream, "rotorwatch/*/*/report", LAB.keys.health):
            session.declare_subscriber(key, at_once(hear))

    narrow: list[str] = []
    wide: list[str] = []
    read: list[str] = []
    with (
        router.client("one") as one,
        router.client("all") as every,
        router.client("monitor") as monitor,
        router.client("lab") as lab,
    ):
        listen(one, narrow)
        listen(every, wide)
        listen(monitor, read)
        monitor.declare_queryable(PUMP.health, lambda query: query.reply(PUMP.health, "fine"))
        token = monitor.liveliness().declare_token(PUMP.monitor_alive)

        def pass_round() -> bool:
            """Publish again, until the last declaration has arrived."""
            lab.put(LAB.keys.stream, "x", congestion_control=zenoh.CongestionControl.BLOCK)
            for key in (PUMP.health, PUMP.alarm_event, LAB.keys.report, LAB.keys.health):
                monitor.put(key, "x", congestion_control=zenoh.CongestionControl.BLOCK)
            return (
                LAB.keys.health in narrow
                and {PUMP.health, PUMP.alarm_event, LAB.keys.health} <= set(wide)
                and LAB.keys.stream in read
            )

        until(pass_round, "health")
        assert set(narrow) == {LAB.keys.health}
        # "rotorwatch/*/*/report" is wider than either grant.
        assert set(wide) == {PUMP.health, PUMP.alarm_event, LAB.keys.health}
        for session, replies in ((every, ["fine"]), (one, [])):
            assert [text_of(reply) for reply in session.get(PUMP.health, timeout=60.0)] == replies
            alive = session.liveliness().get(PUMP.monitor_alive, timeout=60.0)
            assert len([reply for reply in alive if reply.ok]) == len(replies)
        token.undeclare()  # type: ignore[no-untyped-call]


advanced = partial(advanced_publisher, kept=100, heartbeat_s=0.1)
"""Publishers like those of the monitor and the simulator."""


def collected(
    session: zenoh.Session, key: str, *, history: bool, recovery: bool
) -> tuple[list[str], zenoh.ext.AdvancedSubscriber[None]]:
    texts: list[str] = []
    subscriber = zenoh.ext.declare_advanced_subscriber(
        session,
        key,
        lambda sample: texts.append(sample.payload.to_bytes().decode(errors="replace")),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=300) if history else None,
        recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if recovery else None,
        subscriber_detection=True,
    )
    return texts, subscriber


@pytest.mark.parametrize("mode", ["router", "peer"])
def test_late_joiners_get_cached_blocks_and_events(tmp_path: Path, mode: Literal["router", "peer"]) -> None:
    """Both through a router and through a monitor that listens itself."""
    numbers = [str(number) for number in range(20)]
    with plant(tmp_path, mode) as found, found.client("lab") as lab, found.client("monitor") as monitor:
        stream, events = advanced(lab, LAB.keys.stream), advanced(monitor, LAB.keys.alarm_event)
        monitor.declare_queryable(LAB.keys.alarm_event, lambda q: q.reply(LAB.keys.alarm_event, "all events"))
        for number in numbers:
            stream.put(number)
            events.put(number)
        found.until_heard(LAB.keys.stream, "19")
        found.until_heard(LAB.keys.alarm_event, "19")
        blocks, _ = collected(monitor, LAB.keys.stream, history=True, recovery=True)
        until(lambda: len(blocks) >= 20, "blocks of before")
        with found.client("all") as every, found.client("one") as one:
            by_name, _ = collected(one, LAB.keys.alarm_event, history=True, recovery=True)
            by_pattern, _ = collected(every, "rotorwatch/demo/*/alarm/event", history=True, recovery=True)
            until(lambda: len(by_name) >= 20 and len(by_pattern) >= 20, "events of before")
            assert "all events" in [text_of(reply) for reply in one.get(LAB.keys.alarm_event, timeout=60.0)]
            # A viewer may not read the stream's cache.
            refused, _ = collected(one, LAB.keys.stream, history=True, recovery=True)
            assert [r for r in one.get(f"{LAB.keys.stream}/@adv/**", timeout=60.0) if r.ok] == []
            events.put("last")
            until(lambda: by_name[-1] == "last" and by_pattern[-1] == "last", "the last event")
        assert refused == []
        assert blocks == numbers
        assert by_name == by_pattern == [*numbers, "last"]


def test_a_granted_viewer_recovers_lost_events(router: Plant) -> None:
    # The viewer's own session lets one event in a hundred seconds through: the others are lost, at its end of the link.
    lossy = (
        '[{"id": "lossy", "flows": ["ingress"], "messages": ["put"], '
        f'"rules": [{{"key_expr": "{LAB.keys.alarm_event}", "freq": 0.01}}]}}]'
    )
    numbers = [str(number) for number in range(10)]
    with router.client("monitor") as monitor, router.client("one", downsampling=lossy) as one:
        events = advanced(monitor, LAB.keys.alarm_event)
        plain: list[str] = []
        one.declare_subscriber(LAB.keys.alarm_event, lambda sample: plain.append(sample.payload.to_string()))
        texts, _ = collected(one, LAB.keys.alarm_event, history=False, recovery=True)
        # Once this is answered, the router has the subscribers: the plant's own alone would be sent the first event.
        assert [reply for reply in one.get(LAB.keys.alarm_event, timeout=60.0) if reply.ok] == []
        for number in numbers:
            events.put(number)
        # Each subscriber has a thread of its own: the plain one may be last.
        until(lambda: len(texts) >= 10 and bool(plain), "events that were lost")
        assert texts == numbers
        assert plain == ["0"]


SHIPPED = ROOT / "deploy" / "zenoh"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates made with the commands of the documentation."""
    if shutil.which("openssl") is None:  # a fresh machine has Python, git and make alone
        pytest.skip("openssl is not installed: the documented commands cannot be tried")
    page = (ROOT / "docs" / "zenoh-security.md").read_text(encoding="utf-8")
    (commands,) = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    folder = tmp_path_factory.mktemp("certificates")
    text = "set -e\n" + commands.replace("router.plant.example", "localhost")
    subprocess.run(["sh", "-c", text], cwd=folder, check=True, capture_output=True)
    return folder


@contextmanager
def started(recorder: Program, plan: ServiceSettings) -> Iterator[Runtime]:
    """Start a monitor once the recorder is running."""
    recorder.wait_for("recording rotorwatch/demo/lab")
    with running(plan) as service:
        yield service


@pytest.mark.parametrize("level", sorted(path.name for path in SHIPPED.iterdir() if path.is_dir()))
def test_the_shipped_examples_work_together(tmp_path: Path, level: str, request: pytest.FixtureRequest) -> None:
    port = endpoint().rpartition(":")[2]
    folder = tmp_path / "link"
    shutil.copytree(SHIPPED / level, folder)
    if level == "mutual-tls":
        shutil.copytree(request.getfixturevalue("certificates"), folder, dirs_exist_ok=True)
    else:
        names = ("logger-lab", "monitor-1", "control-room")
        kept(folder / "passwords.txt", "".join(f"{name}:of-{name}\n" for name in names))
        for name in names:
            kept(folder / f"{name}.password", f"of-{name}\n")
    for path in folder.glob("*.toml"):
        text = path.read_text(encoding="utf-8").replace("0.0.0.0:7447", f"127.0.0.1:{port}")
        path.write_text(text.replace("router.plant.example:7447", f"localhost:{port}"), encoding="utf-8")
    assert {path.stem for path in folder.glob("*.toml")} == {"router", "monitor", "publisher", "viewer"}
    messages: list[TopicMessage] = []
    plan = ServiceSettings(
        link=load_link(folder / "monitor.toml"), http=HttpSettings(port=0), machines=(MachineEntry(file="lab"),)
    )
    load_link(SHIPPED / level / "router.toml").check_reach("shipped")  # unchanged: on every network of the computer
    gate = Link(load_link(folder / "router.toml"))
    try:
        with (
            program(
                tmp_path, "service", "record", "--machine", "lab", "--out", str(tmp_path / "recorded"),
                "--link", str(folder / "monitor.toml"),
            ) as recorder,
            started(recorder, plan) as service,
            follow(load_link(folder / "viewer.toml"), "demo/*", ("health", "alarm_event"), messages.append),
            program(
                tmp_path, "simulator.rotorsim", "publish", "healthy", "--duration", "3", "--pace", "max",
                "--wait-for-subscriber", "30", "--linger", "0", "--link", str(folder / "publisher.toml"),
            ) as publisher,
        ):  # fmt: skip
            publisher.wait_for("published 30 blocks")
            until(lambda: service.machines()[0].health().stream.data_age_s is not None, "accepted blocks")
            until(lambda: any(message.key == LAB.keys.health for message in messages), "health at the viewer")
            assert recorder.stop() == 0
        (recording,) = (tmp_path / "recorded" / "demo" / "lab").glob("*.mcap")
        assert len([*read_recording(recording, keys=[LAB.keys.stream])]) == 30
    finally:
        gate.close()


def test_rotorsim_reports_a_readable_password_file_and_a_refused_user(tmp_path: Path) -> None:
    address = endpoint()
    (tmp_path / "link.toml").write_text(
        f'[link]\nmode = "client"\nconnect = ["{address}"]\nuser = "lab"\npassword_file = "p"\n', encoding="utf-8"
    )
    arguments = ("simulator.rotorsim", "publish", "--duration", "3", "--link", str(tmp_path / "link.toml"))
    for mode, code, said in ((0o644, 2, "chmod 600"), (0o600, 1, "does not accept the user lab")):
        kept(tmp_path / "p", "word-of-lab").chmod(mode)
        with program(tmp_path, *arguments) as publisher:
            assert publisher.process.wait(180) == code
            assert said in publisher.errors()
            assert "Traceback" not in publisher.errors()
            assert "word-of-lab" not in publisher.errors() + publisher.output()
