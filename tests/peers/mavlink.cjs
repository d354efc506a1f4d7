// Parses a stream of MAVLink bytes with node-mavlink; prints a line of JSON for each message, and whether its signature is
// that of a passphrase. Usage: mavlink.cjs FILE [PASSPHRASE]
const fs = require("node:fs");
const { MavLinkPacketSignature, MavLinkPacketSplitter, MavLinkPacketParser, minimal, common } = require("node-mavlink");

const registry = { ...minimal.REGISTRY, ...common.REGISTRY };
const key = process.argv[3] ? MavLinkPacketSignature.key(process.argv[3]) : null;
const plain = (key, value) => (typeof value === "bigint" ? String(value) : value);
const parser = fs.createReadStream(process.argv[2]).pipe(new MavLinkPacketSplitter()).pipe(new MavLinkPacketParser());
parser.on("data", (packet) => {
  const kind = registry[packet.header.msgid];
  if (kind) {
    const content = packet.protocol.data(packet.payload, kind);
    const signed = Boolean(key && packet.signature && packet.signature.matches(key));
    const { sysid: system, compid: component } = packet.header;
    console.log(JSON.stringify({ name: kind.MSG_NAME, system, component, signed, content }, plain));
  }
});
