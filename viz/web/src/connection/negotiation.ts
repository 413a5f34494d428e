// Agrees with the server on a protocol version and on capabilities.

import { CAPABILITIES, type Hello, type HelloMessage, OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION } from "./protocol";

export interface Agreement {
  /** Capabilities of both sides. */
  capabilities: ReadonlySet<string>;
  /** The reply, unless the server is too old to understand it. */
  hello: HelloMessage | null;
}

/** The reply to a server's hello, or the reason why this page cannot use the server. */
export function agree(hello: Hello): Agreement | string {
  const [oldest, newest] = hello.protocols ?? [hello.protocol, hello.protocol];
  if (newest < OLDEST_PROTOCOL_VERSION || oldest > PROTOCOL_VERSION) {
    return (
      `the server uses protocol version ${oldest === newest ? oldest : `${oldest} to ${newest}`}, ` +
      `this page ${OLDEST_PROTOCOL_VERSION} to ${PROTOCOL_VERSION}: reload the page`
    );
  }
  const offered = hello.capabilities ?? [];
  return {
    capabilities: new Set(CAPABILITIES.filter((name) => offered.includes(name))),
    hello: hello.protocols
      ? { type: "hello", protocols: [OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION], capabilities: CAPABILITIES }
      : null,
  };
}
