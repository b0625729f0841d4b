/** What `kpc-player/three` exports. */

export { KpcObject, type KpcObjectOptions } from './kpc_object.js';
