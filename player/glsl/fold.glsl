// Multiplies a row of a time plane into one plane of space, for a march that then needs the planes alone.
// Exact at texels; between them the product of two interpolations becomes the interpolation of a product.

uniform sampler2D planes;
uniform sampler2D rows;
uniform ivec2 origin;   // of the plane's block
uniform int width;      // of one layer
uniform int first_row;  // line of layer 0 in `rows`
uniform int upright;    // 1: the row runs along the plane's rows, 0: along its columns

layout(location = 0) out vec4 folded;

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    ivec2 local = at - origin;
    int layer = local.x / width;
    int along = upright == 1 ? local.y : local.x - layer * width;
    folded = texelFetch(planes, at, 0) * texelFetch(rows, ivec2(along, first_row + layer), 0);
}
