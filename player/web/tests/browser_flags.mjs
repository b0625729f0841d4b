/** How tests start Chromium: without a window, and with WebGL by software. */
export const FLAGS = [
  ...['--headless', '--no-sandbox', '--no-first-run', '--disable-sync'],
  ...['--disable-background-networking', '--disable-component-update'],
  ...['--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'],
];
