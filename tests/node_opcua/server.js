// A plant of first order behind node-opcua, a stack that shares nothing with the client's: node server.js PORT FOLDER MS [LIFETIME]
"use strict";
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const { MessageSecurityMode, SecurityPolicy } = require("node-opcua-secure-channel");
const { OPCUAServer } = require("node-opcua-server");
const { DataType } = require("node-opcua-variant");
const { StatusCodes } = require("node-opcua-status-code");

const [port, folder, milliseconds, lifetime] = process.argv.slice(2); // LIFETIME of a channel [ms]
const NAMESPACE = "urn:loopwright:plant";

async function main() {
  const certificates = new OPCUACertificateManager({ rootFolder: `${folder}/pki`, automaticallyAcceptUnknownCertificate: true });
  const users = new OPCUACertificateManager({ rootFolder: `${folder}/users` }); // those in trusted/certs
  const server = new OPCUAServer({
    port: Number(port),
    hostname: "127.0.0.1",
    serverCertificateManager: certificates,
    userCertificateManager: users,
    securityPolicies: [SecurityPolicy.Basic256Sha256],
    securityModes: [MessageSecurityMode.SignAndEncrypt],
    defaultSecureTokenLifetime: lifetime ? Number(lifetime) : undefined,
    allowAnonymous: false,
    userManager: { isValidUser: (user, password) => user === "loopwright" && password === "a secret" },
  });
  await server.initialize();
  const space = server.engine.addressSpace;
  const own = space.registerNamespace(NAMESPACE);
  const plant = own.addObject({ organizedBy: space.rootFolder.objects, browseName: "Plant", nodeId: "s=Plant" });

  const variable = (id, dataType, value, range) => {
    const options = { componentOf: plant, browseName: id, nodeId: `s=${id}`, dataType, minimumSamplingInterval: 50 };
    const made = range
      ? own.addAnalogDataItem({ ...options, engineeringUnitsRange: range, valuePrecision: 0.01 })
      : own.addVariable(options);
    made.setValueFromSource({ dataType, value });
    return made;
  };
  const real = (id, value, low, high) => variable(id, DataType.Float, value, { low, high });
  const ca = real("PV.C_A", 0.5, 0, 1);
  const t = real("PV.T", 300, 200, 600);
  const tj = real("MV.T_j", 250, 0, 500);
  const back = real("RB.T_j", 250, 0, 500);
  const fault = variable("Faults.T", DataType.Int32, 0);
  const watchdog = variable("Watchdog", DataType.Int32, 0);
  variable("Heartbeat", DataType.UInt16, 0);

  let temperature = 300;
  let count = 0;
  setInterval(() => {
    const asked = tj.readValue().value.value;
    temperature += 0.1 * (250 + 0.3 * asked - temperature);
    ca.setValueFromSource({ dataType: DataType.Float, value: 1 - (temperature - 200) / 400 });
    const bad = fault.readValue().value.value === 1;
    t.setValueFromSource({ dataType: DataType.Float, value: temperature }, bad ? StatusCodes.BadSensorFailure : StatusCodes.Good);
    back.setValueFromSource({ dataType: DataType.Float, value: asked });
    watchdog.setValueFromSource({ dataType: DataType.Int32, value: ++count % 30000 });
    const type = DataType[tj.readValue().value.dataType];
    console.log(JSON.stringify({ asked, type }));
  }, Number(milliseconds));
  await server.start();
  console.log(JSON.stringify({ ready: server.getEndpointUrl() }));
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
