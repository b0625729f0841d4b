/** What build.mjs makes of files that are no TypeScript. */

declare module '*.wasm' {
  const bytes: Uint8Array<ArrayBuffer>;
  export default bytes;
}

declare module '*.glsl' {
  const text: string;
  export default text;
}

declare module '*?text' {
  const text: string;
  export default text;
}
