"""The reference client of the dedicated socket, with a stream that continues, has losses, and is restarted."""

from __future__ import annotations

import socket
import struct
import threading

import numpy as np
import pytest

from rosafe.ros1.bass import socket_client
from rosafe.ros1.bass.socket_client import Received, SocketClient, blocks
from tests.harness import PATIENCE, wait_for
from tests.ros1.bass.test_socket import Server, port_content, server

__all__ = ["server"]


def numbers(block: Received) -> list[int]:
    assert np.array_equal(block.samples[1], -block.samples[0])
    return [int(number) for number in block.samples[0]]


def test_one_request(server: Server) -> None:
    with SocketClient(*server.address) as client:
        block = client.read(5, 98)
        assert (block.first, block.lost, numbers(block)) == (98, 0, [98, 99, 100])
        assert client.read(3, 11)[::2] == (81, 70)
        assert client.read(3, 101).samples.shape == (2, 0)
        assert client.newest() == 100
        server.content = None
        assert client.newest() == 0


def test_stream_in_order_with_losses_and_a_restart(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket_client, "RESTART_SECONDS", 0.05)
    host, port = server.address
    stream = blocks(host, port, frames=6, first=95)
    assert numbers(next(stream)) == [95, 96, 97, 98, 99, 100]
    server.content = port_content(108, 20)
    assert [numbers(next(stream)) for _ in range(2)] == [[101, 102, 103, 104, 105, 106], [107, 108]]
    server.content = port_content(150, 20)
    block = next(stream)
    assert (block.first, block.lost) == (131, 22) and numbers(block)[0] == 131
    for _ in range(3):
        assert numbers(next(stream))[-1] <= 150
    server.content = port_content(4, 20)
    block = next(stream)
    assert block.first == 1 and numbers(block) == [1, 2, 3, 4]
    stream.close()


def test_starts_with_the_next_frame_and_stops_on_request(server: Server) -> None:
    host, port = server.address
    stopping = threading.Event()
    stream = blocks(host, port, stopping=stopping)

    def capture() -> None:
        wait_for(lambda: server.reads >= 2, what="the client, which first asks for the newest frame")
        server.content = port_content(103, 20)

    capturing = threading.Thread(target=capture)
    capturing.start()
    assert numbers(next(stream)) == [101, 102, 103]
    capturing.join(PATIENCE)
    stopping.set()
    assert next(stream, None) is None
    assert list(blocks(host, port, patience=0.05)) == []


def test_broken_connection_is_an_error(server: Server) -> None:
    host, port = server.address
    stream = blocks(host, port, first=95)
    next(stream)
    server.stopping.set()
    with pytest.raises(OSError, match=r"closed the connection|reset|Broken pipe"):
        next(stream)
    server.thread.join(PATIENCE)
    with pytest.raises(ConnectionRefusedError):
        next(blocks(host, port))


@pytest.mark.parametrize("header", [(2**31 - 1, 0, 2**31), (-1, 0, 5), (6, 0, 100), (1, -1, 5), (5, 0, 2)])
def test_another_server_cannot_fill_the_memory(header: tuple[int, int, int]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        client = SocketClient(*listener.getsockname())
        connection, _ = listener.accept()
        with connection, client, pytest.raises(OSError, match="this is not a bass"):
            connection.sendall(struct.pack("<iiq", *header))
            client.read(5, 1)
