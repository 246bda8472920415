from .blurs import blur as blur
from .blurs import defocus as defocus
from .blurs import gaussian_blur as gaussian_blur
from .blurs import motion_blur as motion_blur
from .effects import brightness as brightness
from .effects import dimming as dimming
from .effects import flare as flare
from .effects import jpeg as jpeg
from .effects import low_light as low_light
from .effects import noise as noise
from .effects import occlusion as occlusion
from .effects import shadow_edge as shadow_edge
from .ladder import LADDER as LADDER
from .ladder import Severity as Severity
from .ladder import apply_effects as apply_effects
from .ladder import draw_effect as draw_effect
from .ladder import draw_ladder_mix as draw_ladder_mix
from .ladder import draw_paper_mix as draw_paper_mix
from .occluders import limbs as limbs
from .own_images import degrade_files as degrade_files
from .own_images import open_own_images as open_own_images
from .weather import rain as rain
from .weather import rainfall as rainfall
from .weather import shadow as shadow

__all__: list[str]
