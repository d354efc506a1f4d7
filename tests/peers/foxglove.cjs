// Subscribes to every channel of a Foxglove server, prints the first message of each. Usage: foxglove.cjs PORT COUNT
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { WebSocket } = require("ws");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");

const plain = (key, value) =>
  typeof value === "bigint" ? Number(value) : ArrayBuffer.isView(value) ? Array.from(value).slice(0, 36) : value;
const socket = new WebSocket(`ws://127.0.0.1:${process.argv[2]}`, ["foxglove.sdk.v1"]);
const client = new FoxgloveClient({ ws: socket });
const channels = new Map();
const seen = new Set();
client.on("advertise", (advertised) => {
  for (const channel of advertised) {
    channels.set(client.subscribe(channel.id), channel);
  }
});
client.on("message", ({ subscriptionId, data }) => {
  const channel = channels.get(subscriptionId);
  if (seen.has(channel.topic)) return;
  seen.add(channel.topic);
  const content = new MessageReader(parse(channel.schema, { ros2: true })).readMessage(data);
  console.log(JSON.stringify({ topic: channel.topic, content }, plain));
  if (seen.size === Number(process.argv[3])) process.exit(0);
});
