"""The component `bass`, which captures binaural audio, and the type of its port."""

from __future__ import annotations

from rosafe.declarations.parameter import Parameter

from .genom import COMMON_SERVICES, GENOM_STATE, GENOM_STATE_PORT
from .service import ComponentSpec, PortSpec, Service, read_idl

_IDL = read_idl(__file__)
BINAUDIO = _IDL["struct"]

BASS = ComponentSpec(
    name="bass",
    doc="Binaural audio streaming server: captures sound and publishes a sliding window of it",
    services=(
        Service(
            "Acquire",
            "Capture from a device and publish on Audio until stopped",
            (
                Parameter.text(
                    "device",
                    "hw:1,0",
                    "ALSA name of the sound device, file:PATH, bag:PATH, topic:/NAME, scene: or scene:FILE.yaml",
                ),
                Parameter.count(
                    "sampleRate",
                    44100,
                    "Sample rate (Hz); 0: that of the source with file: and bag:, otherwise 44100",
                    0,
                    768000,
                    zero_is_default=False,
                ),
                Parameter.count("nFramesPerChunk", 2205, "Frames in one chunk", 1, 1_000_000),
                Parameter.count("nChunksOnPort", 20, "Chunks in the window on the port", 1, 100_000),
            ),
            throws=("::bass::e_nomem", "::bass::e_device", "::bass::e_hwparams", "::bass::e_swparams"),
            activity=True,
            task="capture",
            interrupts=("Acquire",),
        ),
        Service(
            "ListDevices",
            "Print the capture devices on the component's standard output",
            throws=("::bass::e_nodevice",),
        ),
        Service("Stop", "Stop the acquisition", interrupts=("Acquire",)),
        Service(
            "getAcquisition",
            "The arguments of the running Acquire",
            outputs=(
                ("running", "boolean"),
                ("device", "string"),
                ("sampleRate", "unsigned long"),
                ("nFramesPerChunk", "unsigned long"),
                ("nChunksOnPort", "unsigned long"),
            ),
        ),
        Service(
            "DedicatedSocket",
            "Serve the Audio port's content on TCP port 8081 until closed",
            activity=True,
            task="socket",
            interrupts=("DedicatedSocket",),
        ),
        Service(
            "CloseSocket",
            "Close the dedicated socket and all its connections",
            activity=True,
            task="socket",
            interrupts=("DedicatedSocket",),
        ),
        *COMMON_SERVICES,
    ),
    ports=(
        PortSpec("Audio", "::binaudio::portStruct", "The newest audio: a window that slides by one chunk"),
        GENOM_STATE_PORT,
    ),
    tasks=("capture", "socket"),
    exceptions={
        "e_nomem": "out of memory",
        "e_nodevice": "no sound card",
        "e_device": "the device does not exist, is busy or was disconnected",
        "e_hwparams": "the device does not support the requested parameters",
        "e_swparams": "the device's software parameters cannot be set",
    },
    structs={**BINAUDIO, **GENOM_STATE},
    messages=_IDL["message"],
)
