// Reads an MCAP file with Foxglove's own decoders; prints a line of JSON for each message. Usage: mcap.cjs FILE
const fs = require("node:fs/promises");
const { McapIndexedReader } = require("@mcap/core");
const { FileHandleReadable } = require("@mcap/nodejs");
const { loadDecompressHandlers } = require("@mcap/support");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");

const plain = (key, value) =>
  typeof value === "bigint" ? Number(value) : ArrayBuffer.isView(value) ? Array.from(value).slice(0, 36) : value;

async function main() {
  const readable = new FileHandleReadable(await fs.open(process.argv[2]));
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
  const readers = new Map();
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    const schema = reader.schemasById.get(channel.schemaId);
    if (!readers.has(channel.id)) {
      const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
      readers.set(channel.id, new MessageReader(definition));
    }
    const content = readers.get(channel.id).readMessage(message.data);
    console.log(JSON.stringify({ topic: channel.topic, t_ns: String(message.logTime), content }, plain));
  }
}
main();
