/** What `kpc-player/three` exports. */

export { KpcObject, type KpcObjectEventMap, type KpcObjectOptions } from './kpc_object.js';
