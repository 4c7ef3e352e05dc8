// The WebSocket to the server: requests and answers, messages by subject, columns of plots.

const FORMAT = 2;
const HEADER_BYTES = 8;
const PIECE_BYTES = 40;
const FATAL_CODES = [1002, 1003, 1007, 1009, 1011]; // close codes after which reconnecting would fail again

export class Link extends EventTarget {
  #socket = null;
  #number = 0;
  #pending = new Map();
  #retryDelay = 500;
  #address;
  bytes = 0;
  refusal = ""; // why the server rejects this page

  constructor(token) {
    super();
    this.#address = `socket?token=${encodeURIComponent(token)}`;
  }

  open() {
    const socket = new WebSocket(`ws://${location.host}/${this.#address}`);
    socket.binaryType = "arraybuffer";
    socket.addEventListener("open", () => {
      this.#socket = socket;
      this.#retryDelay = 500;
      this.refusal = "";
      this.#emit("open", {});
    });
    socket.addEventListener("message", (event) => {
      if (typeof event.data === "string") this.#receiveText(JSON.parse(event.data));
      else this.#receiveColumns(event.data);
    });
    socket.addEventListener("close", async ({ code, reason }) => {
      if (!this.#socket) await this.#fetchRefusal();
      this.#socket = null;
      for (const { reject } of this.#pending.values()) reject(new Error("the connection to the server was lost"));
      this.#pending.clear();
      const fatal = FATAL_CODES.includes(code);
      this.#emit("close", { reason, fatal });
      if (fatal) return;
      setTimeout(() => this.open(), this.#retryDelay);
      this.#retryDelay = Math.min(5000, this.#retryDelay * 1.6);
    });
  }

  // Browsers hide from scripts why a WebSocket was rejected; the same request by HTTP returns the reason.
  async #fetchRefusal() {
    const answer = await fetch(this.#address, { signal: AbortSignal.timeout(3000) }).catch(() => null);
    this.refusal = answer && [403, 503].includes(answer.status) ? (await answer.text()).trim() : "";
  }

  request(action, values = {}) {
    if (!this.#socket) return Promise.reject(new Error("there is no connection to the server"));
    const id = ++this.#number;
    this.#socket.send(JSON.stringify({ id, do: action, with: values }));
    return new Promise((resolve, reject) => this.#pending.set(id, { resolve, reject }));
  }

  #receiveText(message) {
    if (message.about !== "answer") {
      this.#emit(message.about, message);
      return;
    }
    const pending = this.#pending.get(message.id);
    this.#pending.delete(message.id);
    if (message.error !== undefined) pending?.reject(new Error(message.error));
    else pending?.resolve(message.ok);
  }

  #receiveColumns(buffer) {
    const bytes = new DataView(buffer);
    if (bytes.getUint16(0, true) !== FORMAT) return;
    this.bytes += buffer.byteLength;
    let at = HEADER_BYTES;
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
        piece.values = new Float32Array(buffer, at + PIECE_BYTES, numbers);
      } else {
        const low = bytes.getFloat32(at + 24, true);
        const step = (bytes.getFloat32(at + 28, true) - low) / 254;
        const steps = new Uint8Array(buffer, at + PIECE_BYTES, numbers);
        piece.values = Float32Array.from(steps, (value) => (value === 255 ? NaN : low + value * step));
      }
      this.#emit("columns", piece);
      at += PIECE_BYTES + Math.ceil((numbers * (floats ? 4 : 1)) / 8) * 8;
    }
  }

  #emit(subject, detail) {
    this.dispatchEvent(new CustomEvent(subject, { detail }));
  }
}
