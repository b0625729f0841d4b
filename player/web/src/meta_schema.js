/** The JSON Schema of metadata, spec/meta.schema.json, which a test holds it equal to. */
/** @type {any} */
export const SCHEMA = {
 "$schema": "https://json-schema.org/draft/2020-12/schema",
 "title": "Metadata of a .kpc file",
 "type": "object",
 "properties": {
  "title": {
   "type": "string",
   "minLength": 1,
   "maxLength": 256
  },
  "description": {
   "type": "string",
   "minLength": 1,
   "maxLength": 4096
  },
  "author": {
   "type": "string",
   "minLength": 1,
   "maxLength": 256
  },
  "licence": {
   "type": "string",
   "minLength": 1,
   "maxLength": 256
  },
  "date": {
   "type": "string",
   "pattern": "^[0-9]{4}(-[0-9]{2}(-[0-9]{2})?)?$"
  },
  "up": {
   "type": "array",
   "minItems": 3,
   "maxItems": 3,
   "items": {
    "type": "number",
    "minimum": -1073741824,
    "maximum": 1073741824
   }
  },
  "metres_per_unit": {
   "type": "number",
   "exclusiveMinimum": 0,
   "maximum": 1073741824
  },
  "transparent": {
   "type": "boolean"
  },
  "opening": {
   "type": "object",
   "required": ["camera", "time"],
   "properties": {
    "camera": {
     "type": "object",
     "required": ["width", "height", "focal", "centre", "pose"],
     "properties": {
      "width": {
       "type": "integer",
       "minimum": 1,
       "maximum": 65535
      },
      "height": {
       "type": "integer",
       "minimum": 1,
       "maximum": 65535
      },
      "focal": {
       "type": "array",
       "minItems": 2,
       "maxItems": 2,
       "items": {
        "type": "number",
        "exclusiveMinimum": 0,
        "maximum": 1073741824
       }
      },
      "centre": {
       "type": "array",
       "minItems": 2,
       "maxItems": 2,
       "items": {
        "type": "number",
        "minimum": -1073741824,
        "maximum": 1073741824
       }
      },
      "pose": {
       "type": "array",
       "minItems": 12,
       "maxItems": 12,
       "items": {
        "type": "number",
        "minimum": -1073741824,
        "maximum": 1073741824
       }
      }
     }
    },
    "time": {
     "type": "number",
     "minimum": 0,
     "maximum": 1
    }
   }
  },
  "view_limits": {
   "type": "object",
   "required": ["focus", "forward", "azimuth", "elevation", "distance", "reach"],
   "properties": {
    "focus": {
     "type": "array",
     "minItems": 3,
     "maxItems": 3,
     "items": {
      "type": "number",
      "minimum": -1073741824,
      "maximum": 1073741824
     }
    },
    "forward": {
     "type": "array",
     "minItems": 3,
     "maxItems": 3,
     "items": {
      "type": "number",
      "minimum": -1073741824,
      "maximum": 1073741824
     }
    },
    "azimuth": {
     "type": "array",
     "minItems": 2,
     "maxItems": 2,
     "items": {
      "type": "number",
      "minimum": -360,
      "maximum": 360
     }
    },
    "elevation": {
     "type": "array",
     "minItems": 2,
     "maxItems": 2,
     "items": {
      "type": "number",
      "minimum": -360,
      "maximum": 360
     }
    },
    "distance": {
     "type": "array",
     "minItems": 2,
     "maxItems": 2,
     "items": {
      "type": "number",
      "exclusiveMinimum": 0,
      "maximum": 1073741824
     }
    },
    "reach": {
     "type": "number",
     "minimum": 0,
     "maximum": 1073741824
    }
   }
  },
  "camera_names": {
   "type": "array",
   "maxItems": 4096,
   "items": {
    "type": "string",
    "minLength": 1,
    "maxLength": 255
   }
  },
  "provenance": {
   "type": "object",
   "properties": {
    "encoder": {
     "type": "string",
     "minLength": 1,
     "maxLength": 256
    },
    "dataset_sha256": {
     "type": "string",
     "pattern": "^[0-9a-f]{64}$"
    },
    "layout": {
     "type": "string",
     "minLength": 1,
     "maxLength": 256
    },
    "preset": {
     "type": "string",
     "minLength": 1,
     "maxLength": 256
    },
    "options": {
     "type": "object",
     "additionalProperties": {
      "type": ["string", "number", "boolean"],
      "maxLength": 256
     }
    },
    "seed": {
     "type": "integer",
     "minimum": 0
    },
    "held_out": {
     "type": "object",
     "properties": {
      "pictures": {
       "type": "integer",
       "minimum": 1
      },
      "psnr_db": {
       "type": "number"
      },
      "ssim": {
       "type": "number"
      },
      "moving_psnr_db": {
       "type": "number"
      },
      "still_psnr_db": {
       "type": "number"
      }
     }
    },
    "coding_loss_db": {
     "type": "number"
    },
    "history": {
     "type": "array",
     "maxItems": 64,
     "items": {
      "type": "string",
      "minLength": 1,
      "maxLength": 256
     }
    }
   }
  }
 }
};
