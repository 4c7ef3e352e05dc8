// The result of link.js for a message with one column of the given number.
const [low, high] = arguments;
class Socket extends EventTarget { constructor() { super(); Socket.one = this; } }
const real = window.WebSocket;
window.WebSocket = Socket;
return import("/link.js").then(({ Link }) => {
  const link = new Link();
  link.open();
  window.WebSocket = real;
  const buffer = new ArrayBuffer(56), bytes = new DataView(buffer);
  bytes.setUint16(0, 2, true); bytes.setUint16(2, 1, true);
  bytes.setUint32(8, 7, true); bytes.setUint16(12, 1, true); bytes.setUint16(14, 1, true);
  bytes.setUint32(16, low, true); bytes.setUint32(20, high, true); bytes.setFloat64(24, 12.5, true);
  bytes.setUint8(40, 1); bytes.setUint8(41, 3); bytes.setFloat32(48, 0.25, true);
  let got = null;
  link.addEventListener("columns", ({ detail }) => { got = { ...detail, values: [...detail.values], first: String(detail.first) }; });
  Socket.one.dispatchEvent(new MessageEvent("message", { data: buffer }));
  return got;
});
