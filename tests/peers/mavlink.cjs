// Parses a stream of MAVLink bytes with node-mavlink; prints a line of JSON for each message. Usage: mavlink.cjs FILE
const fs = require("node:fs");
const { MavLinkPacketSplitter, MavLinkPacketParser, minimal, common } = require("node-mavlink");

const registry = { ...minimal.REGISTRY, ...common.REGISTRY };
const plain = (key, value) => (typeof value === "bigint" ? String(value) : value);
const parser = fs.createReadStream(process.argv[2]).pipe(new MavLinkPacketSplitter()).pipe(new MavLinkPacketParser());
parser.on("data", (packet) => {
  const kind = registry[packet.header.msgid];
  if (kind) {
    const content = packet.protocol.data(packet.payload, kind);
    console.log(JSON.stringify({ name: kind.MSG_NAME, component: packet.header.compid, content }, plain));
  }
});
