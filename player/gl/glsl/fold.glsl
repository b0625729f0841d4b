// Multiplies a time row into one space plane, for a march that then needs the planes alone (kpc.player.gl.folding).

uniform sampler2D upsampled;   // the planes, where they are written, too
uniform sampler2D rows;        // texel for texel
uniform vec2 upsampled_texel;  // 1 / size of the texture, as the next
uniform vec2 folded_rows_texel;
uniform vec2 origin;           // of the plane's block, texels
uniform float width;           // of one layer, texels
uniform bool along_rows;       // the row has one value for each row of the plane, else one for each column
uniform int line;              // of the row's first layer
uniform float largest;         // number that can be written

layout(location = 0) out vec4 folded;

void main() {
    vec2 local = gl_FragCoord.xy - origin;
    float layer = floor(local.x / width), along = along_rows ? local.y : local.x - layer * width;
    vec4 product = textureLod(upsampled, gl_FragCoord.xy * upsampled_texel, 0.0)
                 * textureLod(rows, vec2(along, float(line) + layer + 0.5) * folded_rows_texel, 0.0);
    folded = clamp(product, -largest, largest);
}
