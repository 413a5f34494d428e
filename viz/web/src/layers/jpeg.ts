// Decodes JPEG images.

/** The image in a part of a payload; all of the payload if there is no part. */
export function decodeJpeg(
  payload: Uint8Array<ArrayBuffer>,
  { offset, bytes }: { offset: number; bytes: number } = { offset: 0, bytes: payload.length },
  options: ImageBitmapOptions = {},
): Promise<ImageBitmap> {
  return createImageBitmap(new Blob([payload.subarray(offset, offset + bytes)], { type: "image/jpeg" }), options);
}

/** Draws an image at its own size. The canvas takes it over. */
export function drawBitmap(canvas: HTMLCanvasElement, bitmap: ImageBitmap): void {
  canvas.width = bitmap.width;
  canvas.height = bitmap.height;
  canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
  bitmap.close();
}
