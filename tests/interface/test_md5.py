"""The md5 sums of all messages, services and actions; clients and bags of the original remain compatible."""

from __future__ import annotations

import importlib

import pytest

from rosafe import interface

EMPTY_REPLY = "0d79450287345aef3f3e331856b25242"  # genom_success, genom_exdetail

MESSAGES = {
    "rosAFE/rosAFE_signalOneD": "788898178a3da2c3718461eecda8f714",
    "rosAFE/rosAFE_signalND": "045d0d051cbe9955e7f9498a29643cdd",
    "rosAFE/rosAFE_signalNxND": "489f9dc366e74e2b5bf03965a2f57bd0",
    "rosAFE/rosAFE_TimeDomainSignalPortStruct": "c5c9f0ba2cf57ffea6f64fd3a8f06dfc",
    "rosAFE/rosAFE_TimeFrequencySignalPortStruct": "93d830196cc425f32a8ee826674dac8f",
    "rosAFE/rosAFE_CrossCorrelationSignalPortStruct": "99f486a343996cd732a7710af349023f",
    "rosAFE/rosAFE_inputProcsParametres": "cae9b38e2e9a81defbfb7a3f8f9f31d1",
    "rosAFE/rosAFE_preProcsParametres": "468cbabc203bd44e98d4299fb98e862d",
    "rosAFE/rosAFE_gammatoneProcsParametres": "ec93fecbae317bf5cc7c6103f65127ca",
    "rosAFE/rosAFE_ihcProcsParametres": "dfffa128865d877ef2214b01e884b9b4",
    "rosAFE/rosAFE_ildProcsParametres": "f1ca8518fd1c94835fe0ab1bcf1069ce",
    "rosAFE/rosAFE_ratemapProcsParametres": "d0c10fe317b0c3473a37cf7c93c2ee32",
    "rosAFE/rosAFE_crossCorrelationParametres": "f7cdbf1ea368009f5fe91c22763f8139",
    "rosAFE/rosAFE_parameters": "6fbd959f2790cd306789a3c496da58d8",
    "rosAFE/rosAFE_dataObjSt": "b4fcb07a721bbedc2794212a5895a072",
    "rosAFE/rosAFE_AutoCorrelationSignalPortStruct": "2f49295664727f8312963c7a96898807",
    "rosAFE/rosAFE_ModulationSignalPortStruct": "1d45c46bc079dd3bc1c3d9d3d51de506",
    "rosAFE/rosAFE_PrecedenceSignalPortStruct": "3a17e00f4f3f08698233c96fafdc599f",
    "rosAFE/rosAFE_frameTime": "71000c3c423c07bf5aec49422c09a26b",
    "rosAFE/rosAFE_processor": "d988720cc9980c92234fa266f9bfacac",
    "rosAFE/rosAFE_parameterValue": "bc6ccc4a57f61779c8eaae61e9f422e0",
    "rosAFE/rosAFE_representation": "c0e27661a01b45de8f1cd6b85959f3f5",
    **{
        f"{package}/{name}": md5
        for package in ("rosAFE", "bass")
        for name, md5 in {
            "binaudio_timestamp": "4771ad66fef816d2e4bead2f45a1cde6",
            "binaudio_portStruct": "a3b73b6f3547870cf712571c1a85ea1d",
            "genom_state_component": "d7045eed14f90201e8d03c3bee8bd266",
        }.items()
    },
}
COMMON_SERVICES = {
    "connect_port": "f373a4b174400403f47052cfc240215e",
    "connect_service": "f373a4b174400403f47052cfc240215e",
    "abort_activity": "f1ec71d84e024b77cbdc293016ea6480",
    "kill": EMPTY_REPLY,
    "Stop": EMPTY_REPLY,
}
SERVICES = {
    "rosAFE": {
        **COMMON_SERVICES,
        "getSignals": "e0145475f9e769acb1feaed8cb1b3aac",
        "getDependencies": "b1e1876d1baad4bde2f851fdb14fa3f1",
        "getParameters": "23892d967dbdf09f7d67b7042aa685d1",
        "getProcessors": "7fed012e8cf2f34ab373263637c80de7",
        "getRepresentation": "1661edc2013808ada1bd3c2de8ea9d84",
        "modifyParameter": "972a89083cfb6e30281281ef02eaf593",
        "removeProcessor": "a04032386d532fbd9abbc736abb34893",
        "request": "ba0b1737531cf2d4c5f90f7a785a29f5",
        "find": "ba0b1737531cf2d4c5f90f7a785a29f5",
        "saveSetup": "bd80b5122fed958f5b1064544766cd1e",
        "loadSetup": "2d2423f88caa1ef6d6a61623ccc9b472",
        "removeUnused": "a48e4dca96e0e251f987f8765c33798f",
    },
    "bass": {**COMMON_SERVICES, "ListDevices": EMPTY_REPLY, "getAcquisition": "1393f375a654c7c5f67cac5c520e194b"},
}
ACTIONS = {  # (package, action): (Action, Goal, ActionGoal)
    ("rosAFE", "InputProc"): (
        "2dc56590e981689aa1ab72a9e6db474e",
        "ecdbbf792a68bf997a2757c1ecdc6414",
        "20f310617f82ceef1d4e063b57150da3",
    ),
    ("rosAFE", "PreProc"): (
        "7a4642997d62893166fcbf886f4fc091",
        "e06bdbb4062355f0123c80bc35000031",
        "51cad8a3b4bc4ad8bb46cb2879577983",
    ),
    ("rosAFE", "GammatoneProc"): (
        "23f7ea7f2e90a4bf87ce7584f47fe4dd",
        "f88b759b382812a0fd21074996e6b9b5",
        "94377811edd4209c7cd5d4f692069b33",
    ),
    ("rosAFE", "IhcProc"): (
        "788afb05a38d28dc9bad27880aa3f0ea",
        "399842dcc04ac266296cc4f1b922ecd0",
        "ab2455f65e1150e1e9ed05de5157fe23",
    ),
    ("rosAFE", "IldProc"): (
        "26416ae458d0ef3322689985ab9ee7f2",
        "6d4dfec7008d0d09406a9946052c1ff6",
        "97bd84b5041141d2482d46baa194646e",
    ),
    ("rosAFE", "RatemapProc"): (
        "0417ee4145f7f14b08b58e812edb55ee",
        "d3f8108ba8fa091e597107f98f8168c7",
        "5ce772b36eb006b6c0d676ebf788c86c",
    ),
    ("rosAFE", "CrossCorrelationProc"): (
        "b91f30b63436aa28e350468ee0540675",
        "7b2f727618274feaca3820f44fc3b6e0",
        "e4c2aa831426abbe5277111ee33c70fe",
    ),
    ("bass", "Acquire"): (
        "2449774938bc575daaea187dd63c3953",
        "8046a4bb25998729dd0ea883312510c6",
        "35dbed5e68d4a7946fa4fbf96f1b2d3b",
    ),
    ("bass", "DedicatedSocket"): (
        "bfdb9098ad5517a56257d6072d49cc3e",
        "d41d8cd98f00b204e9800998ecf8427e",
        "4b30be6cd12b9e72826df56b481f40e0",
    ),
    ("bass", "CloseSocket"): (
        "bfdb9098ad5517a56257d6072d49cc3e",
        "d41d8cd98f00b204e9800998ecf8427e",
        "4b30be6cd12b9e72826df56b481f40e0",
    ),
}
ACTION_COMMON = {
    "ActionResult": "c034e8d35a5356671342a71f43dbeb20",
    "Result": EMPTY_REPLY,
    "Feedback": "d41d8cd98f00b204e9800998ecf8427e",
    "ActionFeedback": "aae20e09065c3809e8a8e87c4c8953fd",
}


def md5(package: str, kind: str, name: str) -> str:
    return str(getattr(importlib.import_module(f"{package}.{kind}"), name)._md5sum)


@pytest.mark.parametrize("name", MESSAGES)
def test_message(name: str) -> None:
    package, message = name.split("/")
    assert md5(package, "msg", message) == MESSAGES[name]


@pytest.mark.parametrize(("package", "service"), [(p, s) for p, services in SERVICES.items() for s in services])
def test_service(package: str, service: str) -> None:
    assert md5(package, "srv", service) == SERVICES[package][service]


@pytest.mark.parametrize(("package", "action"), ACTIONS)
def test_action(package: str, action: str) -> None:
    found = tuple(md5(package, "msg", action + part) for part in ("Action", "Goal", "ActionGoal"))
    assert found == ACTIONS[package, action]
    assert {part: md5(package, "msg", action + part) for part in ACTION_COMMON} == ACTION_COMMON


def test_all_services_and_actions_are_covered() -> None:
    functions = {c.name: {s.name for s in c.on_graph if not s.activity} for c in interface.COMPONENTS.values()}
    later = {kind.request for kind in interface.KINDS.values() if kind.kind not in interface.CORE_REPRESENTATIONS}
    activities = {(c.name, s.name) for c in interface.COMPONENTS.values() for s in c.activities if s.name not in later}
    assert functions == {package: set(services) for package, services in SERVICES.items()}
    assert activities == set(ACTIONS)
