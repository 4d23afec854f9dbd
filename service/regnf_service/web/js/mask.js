// A mask as a mark in a picture: a PNG that is not black on the thing.

const TINT = [19, 150, 90, 120]; // red, green, blue, opacity

/** The shape of a mark in a frame: { frame, mask, tint }. mask: the PNG as base64; tint: what is drawn over the picture. */
export async function maskShape(frame, file) {
  const mask = await base64(file);
  const picture = await createImageBitmap(file);
  const canvas = new OffscreenCanvas(picture.width, picture.height);
  const pencil = canvas.getContext('2d');
  pencil.drawImage(picture, 0, 0);
  const pixels = pencil.getImageData(0, 0, canvas.width, canvas.height);
  const { data } = pixels;
  for (let i = 0; i < data.length; i += 4) {
    const isThing = Math.max(data[i], data[i + 1], data[i + 2]) > 0;
    for (let part = 0; part < 4; part += 1) data[i + part] = isThing ? TINT[part] : 0;
  }
  pencil.putImageData(pixels, 0, 0);
  return { frame, mask, tint: canvas };
}

async function base64(file) {
  const reader = new FileReader();
  const read = new Promise((resolve, reject) => {
    reader.onload = () => resolve(reader.result);
    reader.onerror = () => reject(reader.error);
  });
  reader.readAsDataURL(file);
  return (await read).replace(/^[^,]*,/, '');
}
