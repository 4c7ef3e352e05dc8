// The connection to the server: requests with answers, news by their subject, columns of pictures.

const FORMAT = 2;
const HEAD = 8;
const PIECE = 40;
const FAILED = [1002, 1003, 1007, 1009, 1011]; // codes after which another try would fail, too

export class Link extends EventTarget {
  #socket = null;
  #number = 0;
  #waiting = new Map();
  #pause = 500;
  #address;
  bytes = 0;
  pictures = 0;
  refusal = ""; // why the server does not accept this page

  constructor(token) {
    super();
    this.#address = `socket?token=${encodeURIComponent(token)}`;
  }

  open() {
    const socket = new WebSocket(`ws://${location.host}/${this.#address}`);
    socket.binaryType = "arraybuffer";
    socket.addEventListener("open", () => {
      this.#socket = socket;
      this.#pause = 500;
      this.refusal = "";
      this.#tell("open", {});
    });
    socket.addEventListener("message", (event) => {
      if (typeof event.data === "string") this.#news(JSON.parse(event.data));
      else this.#columns(event.data);
    });
    socket.addEventListener("close", async ({ code, reason }) => {
      if (!this.#socket) await this.#askWhy();
      this.#socket = null;
      for (const { reject } of this.#waiting.values()) reject(new Error("the connection to the server is lost"));
      this.#waiting.clear();
      const failed = FAILED.includes(code);
      this.#tell("close", { reason, failed });
      if (failed) return;
      setTimeout(() => this.open(), this.#pause);
      this.#pause = Math.min(5000, this.#pause * 1.6);
    });
  }

  // Browsers do not tell scripts why a WebSocket was refused; the same request without one does.
  async #askWhy() {
    const answer = await fetch(this.#address, { signal: AbortSignal.timeout(3000) }).catch(() => null);
    this.refusal = answer && [403, 503].includes(answer.status) ? (await answer.text()).trim() : "";
  }

  ask(what, given = {}) {
    if (!this.#socket) return Promise.reject(new Error("there is no connection to the server"));
    const id = ++this.#number;
    this.#socket.send(JSON.stringify({ id, do: what, with: given }));
    return new Promise((resolve, reject) => this.#waiting.set(id, { resolve, reject }));
  }

  #news(message) {
    if (message.about !== "answer") {
      this.#tell(message.about, message);
      return;
    }
    const waiting = this.#waiting.get(message.id);
    this.#waiting.delete(message.id);
    if (message.error !== undefined) waiting?.reject(new Error(message.error));
    else waiting?.resolve(message.ok);
  }

  #columns(buffer) {
    const bytes = new DataView(buffer);
    if (bytes.getUint16(0, true) !== FORMAT) return;
    this.bytes += buffer.byteLength;
    this.pictures += 1;
    let at = HEAD;
    for (let left = bytes.getUint16(2, true); left > 0; left -= 1) {
      const piece = {
        number: bytes.getUint32(at, true),
        count: bytes.getUint16(at + 4, true),
        size: bytes.getUint16(at + 6, true),
        first: Number(bytes.getBigUint64(at + 8, true)), // exact: the server sends none above 2^53
        stride: bytes.getUint8(at + 33),
        end: bytes.getFloat64(at + 16, true),
      };
      const numbers = piece.count * piece.size;
      const floats = bytes.getUint8(at + 32) === 1;
      if (floats) {
        piece.values = new Float32Array(buffer, at + PIECE, numbers);
      } else {
        const low = bytes.getFloat32(at + 24, true);
        const step = (bytes.getFloat32(at + 28, true) - low) / 254;
        const steps = new Uint8Array(buffer, at + PIECE, numbers);
        piece.values = Float32Array.from(steps, (one) => (one === 255 ? NaN : low + one * step));
      }
      this.#tell("columns", piece);
      at += PIECE + Math.ceil((numbers * (floats ? 4 : 1)) / 8) * 8;
    }
  }

  #tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}
