// Agrees with the server on a protocol version and on capabilities.

import { CAPABILITIES, type Hello, type HelloMessage, OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION } from "./protocol";

export interface Agreement {
  /** Capabilities of both sides. */
  capabilities: ReadonlySet<string>;
  /** The reply, unless the server is too old to understand it. */
  hello: HelloMessage | null;
}

/**
 * The reply to a server's hello, or the reason why this page cannot use the server. The page can use its own
 * capabilities and those of its topics.
 */
export function agree(hello: Hello, topicCapabilities: readonly string[]): Agreement | string {
  const [oldest, newest] = hello.protocols ?? [hello.protocol, hello.protocol];
  if (newest < OLDEST_PROTOCOL_VERSION || oldest > PROTOCOL_VERSION) {
    return (
      `the server uses protocol version ${oldest === newest ? oldest : `${oldest} to ${newest}`}, ` +
      `this page ${OLDEST_PROTOCOL_VERSION} to ${PROTOCOL_VERSION}: reload the page`
    );
  }
  const offered = hello.capabilities ?? [];
  const usable = [...CAPABILITIES, ...topicCapabilities];
  return {
    capabilities: new Set(usable.filter((name) => offered.includes(name))),
    hello: hello.protocols
      ? { type: "hello", protocols: [OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION], capabilities: usable }
      : null,
  };
}
