// Decompresses zlib streams.

/** Decompresses a zlib stream. Stops with an error above a maximum length. */
export async function inflated(zlib: Uint8Array<ArrayBuffer>, maxBytes: number): Promise<Uint8Array<ArrayBuffer>> {
  const chunks: Uint8Array<ArrayBuffer>[] = [];
  let nBytes = 0;
  const reader = new Blob([zlib]).stream().pipeThrough(new DecompressionStream("deflate")).getReader();
  for (let next = await reader.read(); !next.done; next = await reader.read()) {
    chunks.push(next.value);
    nBytes += next.value.length;
    if (nBytes > maxBytes) {
      void reader.cancel();
      throw new Error(`compressed data is longer than ${maxBytes} bytes`);
    }
  }
  const bytes = new Uint8Array(nBytes);
  let offset = 0;
  for (const chunk of chunks) {
    bytes.set(chunk, offset);
    offset += chunk.length;
  }
  return bytes;
}
